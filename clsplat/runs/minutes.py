"""The number of steps that fit into a time.

The pipeline is rehearsed in few steps, and what that took is continued.  How many Gaussians grow is only known when
they have grown; then the number is corrected.  It is written into the run's pipeline, so that its bits repeat.
"""

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from clsplat.errors import ConfigError, Interrupted
from clsplat.files import scratch_folder
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.stretching import last_edit, of_trainings, stretched, with_steps
from clsplat.runs.folders import Start
from clsplat.runs.rehearsal import Rehearsal, most_steps, predicted
from clsplat.runs.runner import run_stages, write_pipeline
from clsplat.signals import stop_if_signalled
from clsplat.stages.keeping import Keeping
from clsplat.stages.training import Training
from clsplat.training.run import Progress, Run
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")
FIRST = 200  # steps of the first rehearsal at most; a training says how many of its own are enough
LONGER = 3  # times the steps of one before
SHARE = 0.03  # of the time: rehearsals that took less are followed by a longer one
REPORTS = 20  # of a rehearsal; each gives the median time of its steps, without what is done once

Show = Callable[[Progress], None]
Execute = Callable[[Pipeline, Run, Start, Show], None]


def execute_within(minutes: float, pipeline: Pipeline, run: Run, start: Start, show: Show, execute: Execute) -> None:
    """Execute the pipeline in as many steps as take `minutes`, with their rehearsal.

    Raises ConfigError where not exactly one stage trains, or its fewest steps take longer, and what `execute` raises.
    """
    until = time.perf_counter() + 60 * minutes
    rehearsals = rehearsals_of(pipeline, run, minutes)
    chosen = pipeline_for(pipeline, rehearsals, until - time.perf_counter(), minutes)
    last, plan = rehearsals[-1], chosen

    def correct(report: Progress) -> Pipeline:
        planned = plan.settings.training.steps
        share, each = report.step / planned, report.milliseconds / 1e3  # of the steps since the last edit
        mean, end = (ratio * each for ratio in last.later(share))
        rest = last.after + last.during * (1 - share) + mean * (planned - report.step)
        more = math.floor((until - time.perf_counter() - rest) / end)
        is_known = share >= last.known[-1]  # before, steps become slower still, by nobody knows how much
        least = min(planned, last_edit(plan.settings.training))
        steps = max(report.step + 2, least, planned + (more if is_known else min(more, 0)))
        reason = f"--minutes {minutes:g}: {steps:,} steps, of which {report.step:,} had shown what one takes"
        LOG.info("%s: %.0f ms", reason, report.milliseconds)
        return replace(plan, settings=with_steps(plan.settings, steps, report.step), reason=reason)

    for share in last.known:
        training = plan.settings.training
        pause = Pause(new_run(run, plan), round(share * training.steps) + training.log_every, correct)
        try:
            execute(plan, pause.run, start, pause.showing(show))
        except Interrupted:
            if pause.corrected is None:
                raise
            stop_if_signalled()
        if pause.corrected is None:
            return
        plan, start = pause.corrected, "resume"
        del pause  # and the tables of its run on the device
    execute(plan, new_run(run, plan), start, show)


@dataclass
class Pause:
    """Corrects the pipeline of a run at a report, and interrupts it: its checkpoint is of the corrected one."""

    run: Run
    at: int
    correct: Callable[[Progress], Pipeline]
    corrected: Pipeline | None = None

    def showing(self, show: Show) -> Show:
        """Return a function that shows reports, and interrupts the run."""

        def shown(progress: Progress) -> None:
            show(progress)
            if self.at <= progress.step < progress.steps and not self.run.interrupted:
                self.corrected = self.correct(progress)
                write_pipeline(self.corrected, self.run)  # before the checkpoint: whoever resumes takes it
                self.run.settings, self.run.pipeline = self.corrected.settings, self.corrected.resolved()
                self.run.interrupted = True

        return shown


def rehearsals_of(pipeline: Pipeline, run: Run, minutes: float) -> list[Rehearsal]:
    """Return rehearsals in growing numbers of steps; the longest takes a small part of the time, or is the first.

    Raises ConfigError where not exactly one stage trains.
    """
    trains = sum(isinstance(stage, Training) for stage in pipeline.stages)
    if trains != 1:
        raise ConfigError(f"{pipeline.path}: --minutes: expected one stage that trains, found {trains}; leave it out")
    training = pipeline.settings.training
    if isinstance(training, Keeping) and training.refit:
        made = [f", chosen by {one.reason}" for one in pipeline.settings.choices if "optimize.refit" in one.keys]
        told = f"a refit trains twice, for nobody knows how long{''.join(made)}; add --set optimize.refit=false"
        raise ConfigError(f"{pipeline.path}: --minutes: {told} to train once, or leave --minutes out")
    first, found, took = fewest(training), list[Rehearsal](), 0.0
    until = time.perf_counter() + 60 * minutes
    run.status.note(seconds_left=None)
    with run.status.stage("rehearse"):
        while took < SHARE * 60 * minutes:
            number, began = first * LONGER ** len(found), time.perf_counter()
            LOG.info("--minutes %g: %s is rehearsed in %d steps", minutes, pipeline.settings.name, number)
            found.append(rehearse(pipeline, run, number / training.steps, until))
            took = time.perf_counter() - began
    return found


def fewest(training: Training) -> int:
    """Return the steps of its first rehearsal, and the fewest that it is cut to."""
    return min(FIRST, training.rehearsed)


def rehearse(pipeline: Pipeline, run: Run, factor: float, until: float) -> Rehearsal:
    """Run all stages of the pipeline in `factor` times its steps; the run is left as it is.

    Raises ConfigError where the clock comes to `until` meanwhile.
    """
    short = replace(pipeline, settings=_reporting(stretched(pipeline.settings, factor)))
    with scratch_folder(run.out / "rehearsal") as out, _only_warnings():
        trained = 0.0

        def show(progress: Progress) -> None:
            nonlocal trained
            trained = time.perf_counter()
            run.status.count("steps", progress.step, progress.steps)
            if trained > until:
                alone = f"a rehearsal in {progress.steps} steps alone takes longer on this device"
                done = f"{progress.step} of them were done in that time"
                raise ConfigError(f"--minutes: expected more: {alone}, {done}; or a pipeline that does less")

        one = new_run(run, short, out=out, status=StatusFile(out), show=show)
        one.records.start()
        start = time.perf_counter()
        run_stages(short, one)
        end = time.perf_counter()
        during = trained - start - one.status.seconds[pipeline.settings.training.stage]
        course = [line["ms"] / 1e3 for line in one.records.read("train")]
        growth = [line["step"] for line in one.records.read("densify") if any(line["grown"].values())]
        return Rehearsal(one.step, course, max(0.0, during), end - trained, max(growth, default=0) / one.step)


def pipeline_for(pipeline: Pipeline, rehearsals: Sequence[Rehearsal], seconds: float, minutes: float) -> Pipeline:
    """Return the pipeline in as many steps as are predicted to take so many seconds.

    Raises ConfigError where those are fewer than the training may have.
    """
    steps, first = pipeline.settings.training.steps, fewest(pipeline.settings.training)
    number = most_steps(rehearsals, seconds)
    if number < first:
        least = minutes + (predicted(rehearsals, first) - seconds) / 60
        expected = f"expected {math.ceil(10 * least) / 10:g} or more for this scene on this device"
        raise ConfigError(f"--minutes {minutes:g}: {expected}, or a pipeline that does less")
    told = f"{number:,} steps in the place of {steps:,}, which take about {seconds / 60:.1f} minutes more"
    reason = f"--minutes {minutes:g}: {told}, by a rehearsal in {rehearsals[-1].steps:,} steps"
    LOG.info("%s", reason)
    return replace(pipeline, settings=_reporting(stretched(pipeline.settings, number / steps)), reason=reason)


def new_run(run: Run, pipeline: Pipeline, **changes: Any) -> Run:
    """Return a run of the pipeline as this one was before its first step, with its device, scene and photographs."""
    own: dict[str, Any] = {"best": None, "best_tables": {}, "numbers": {}, "written": {}, "metrics": {}, "changes": []}
    return replace(run, settings=pipeline.settings, pipeline=pipeline.resolved(), **own, **changes)


def _reporting(settings: PipelineFile) -> PipelineFile:
    """With REPORTS reports of each training, or more: one is needed soon after each share at which it is corrected."""

    def reporting(training: Training) -> Training:
        return training.model_copy(update={"log_every": min(training.log_every, -(-training.steps // REPORTS))})

    return of_trainings(settings, Training, reporting)


@contextmanager
def _only_warnings() -> Iterator[None]:
    """Leave out what a rehearsal tells of itself."""
    level = LOG.level
    LOG.setLevel(logging.WARNING)
    try:
        yield
    finally:
        LOG.setLevel(level)
