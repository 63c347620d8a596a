"""The number of steps that fit into a time (`--minutes`).

A short rehearsal says what a step takes, and what is done besides; a longer one follows where that took little of the
time, for steps become slower as Gaussians grow.  At fixed shares of the training the number is
corrected by the steps that were trained.  It is written into the run's pipeline, so that its bits repeat.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from statistics import fmean
from typing import Any

from clsplat.core.errors import ConfigError, Interrupted
from clsplat.core.files import scratch_folder
from clsplat.core.progress import Progress, log_level
from clsplat.core.signals import stop_if_signaled
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.stretching import last_edit, map_trainings, min_steps, stretched, with_steps
from clsplat.runs.run_folder import Start
from clsplat.runs.runner import check_run, run_stages, write_pipeline
from clsplat.stages.optimize import Keeping
from clsplat.training.run import Run
from clsplat.training.stage import Training
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")
CORRECTED = 0.3, 0.6, 0.85  # shares of the training
STEPS = 200  # of the first rehearsal; a training may say that fewer of its own are enough
LONGER = 3  # times as many steps has the next
SHORTEST = 0.03  # share of the time: a rehearsal that took less is followed by a longer one
REPORTS = 20  # of a training, at least: each gives the median time of its steps
LONGEST = 0.2  # share of the time after which a rehearsal ends its steps
TREND = 0.5  # the steepest power of the number of steps that the time of one is taken to follow

Show = Callable[[Progress], None]
Execute = Callable[[Pipeline, Run, Start, Show], None]


@dataclass(frozen=True)
class Rehearsal:
    """What a pipeline took in few steps, in seconds."""

    steps: int
    course: Sequence[float]  # a step, in equal parts of the training
    during: float  # what comes before the training, and between its steps
    after: float  # what follows the training
    trend: float = 0.0  # the power of the number of steps that the time of one follows

    def steps_in(self, seconds: float) -> int:
        """Return the number of steps that fit."""
        times = max(0.0, seconds - self.during - self.after) / (self.steps * fmean(self.course))
        return math.floor(self.steps * math.pow(times, 1 / (1 + self.trend)))

    def later(self, share: float) -> tuple[float, float]:
        """Return how many times as long as at a share of the training steps take after it: in the mean, and last."""
        place = min(int(share * len(self.course)), len(self.course) - 1)
        return fmean(self.course[place:]) / self.course[place], self.course[-1] / self.course[place]


class _Enough(Exception):
    """Ends the steps of a rehearsal."""


def execute_within(minutes: float, pipeline: Pipeline, run: Run, start: Start, show: Show, execute: Execute) -> None:
    """Execute the pipeline in as many steps as take `minutes`, with their rehearsal.

    Raises ConfigError where not exactly one stage trains, or its fewest steps take longer, and what `execute` raises.
    """
    until = time.perf_counter() + 60 * minutes
    _require_one_training(pipeline)
    check_run(pipeline, run)
    found = rehearse_enough(pipeline, run, minutes, until)
    steps, planned = pipeline.settings.training.steps, found.steps_in(until - time.perf_counter())
    if planned < fewest(pipeline):
        raise _too_few(minutes, pipeline)
    reason = f"--minutes {minutes:g}: {planned:,} steps instead of {steps:,}, by a rehearsal"
    LOG.info("%s", reason)
    plan = replace(pipeline, settings=_reporting(stretched(pipeline.settings, Fraction(planned, steps))), reason=reason)

    def correct(plan: Pipeline, report: Progress) -> Pipeline:
        planned, share, each = report.steps, report.step / report.steps, report.milliseconds / 1e3
        mean, end = (ratio * each for ratio in found.later(share))
        rest = found.after + (1 - share) * found.during + mean * (planned - report.step)
        more = math.floor((until - time.perf_counter() - rest) / end)
        least = min(planned, last_edit(plan.settings.training) + 2)  # and what begins behind it, once
        steps = max(report.step + 2, least, planned + more)
        reason = f"--minutes {minutes:g}: {steps:,} steps, corrected at step {report.step:,}"
        LOG.info("%s: %.0f ms", reason, report.milliseconds)
        return replace(plan, settings=with_steps(plan.settings, steps, report.step), reason=reason)

    for share in CORRECTED:
        corrected = _execute_until(share, plan, new_run(run, plan), start, show, execute, correct)
        if corrected is None:
            return
        plan, start = corrected, "resume"
    execute(plan, new_run(run, plan), start, show)


def _execute_until(
    share: float,
    plan: Pipeline,
    run: Run,
    start: Start,
    show: Show,
    execute: Execute,
    correct: Callable[[Pipeline, Progress], Pipeline],
) -> Pipeline | None:
    """Execute a pipeline up to a share of its training, and save a checkpoint of the corrected one, which is returned.

    None: it ended before.
    """
    corrected: list[Pipeline] = []

    def shown(report: Progress) -> None:
        show(report)
        if share * report.steps <= report.step < report.steps and not run.interrupted:
            corrected.append(correct(plan, report))
            write_pipeline(corrected[0], run)  # before the checkpoint: whoever resumes takes it
            run.settings, run.pipeline = corrected[0].settings, corrected[0].resolved()
            run.interrupted = True

    try:
        execute(plan, run, start, shown)
    except Interrupted:
        if not corrected:
            raise
        stop_if_signaled()
    return corrected[0] if corrected else None


def rehearse_enough(pipeline: Pipeline, run: Run, minutes: float, until: float) -> Rehearsal:
    """Return a rehearsal in so many steps that it takes a small part of the time, with the trend since the one before.

    until: s, on the clock.  Raises ConfigError as `rehearse`.
    """
    steps, began, trend = min(STEPS, pipeline.settings.training.rehearsed), time.perf_counter(), 0.0
    found = rehearse(pipeline, run, steps, minutes, until)
    while time.perf_counter() - began < SHORTEST * 60 * minutes:
        before, steps, began = found, LONGER * steps, time.perf_counter()
        found = rehearse(pipeline, run, steps, minutes, until)
        trend = math.log(fmean(found.course) / fmean(before.course)) / math.log(LONGER)
    return replace(found, trend=min(max(trend, -TREND), TREND))


def rehearse(pipeline: Pipeline, run: Run, steps: int, minutes: float, until: float) -> Rehearsal:
    """Run all stages of the pipeline in few steps; the run is left as it is.

    until: s, on the clock.  Raises ConfigError as soon as it is known that the fewest steps do not fit.
    """
    LOG.info("--minutes %g: %s is rehearsed in %d steps", minutes, pipeline.settings.name, steps)
    short = stretched(pipeline.settings, Fraction(steps, pipeline.settings.training.steps))
    short_pipeline, began = replace(pipeline, settings=_reporting(short)), time.perf_counter()
    reports: list[tuple[float, int, float]] = []  # s on the clock, step, s of one

    def look() -> None:
        each = min(seconds for _, _, seconds in reports[-2:]) if len(reports) > 1 else 0.0  # one may build kernels
        if time.perf_counter() + fewest(pipeline) * each > until:
            raise _too_few(minutes, pipeline)

    def show(report: Progress) -> None:
        run.status.count("steps", report.step, report.steps)
        reports.append((time.perf_counter(), report.step, report.milliseconds / 1e3))
        look()
        if report.step < report.steps and reports[-1][0] - reports[0][0] > LONGEST * 60 * minutes:
            raise _Enough

    run.status.note(seconds_left=None)
    with scratch_folder(run.out / "rehearsal") as out, log_level(logging.WARNING), run.status.stage("rehearse"):
        one = new_run(run, short_pipeline, out=out, status=StatusFile(out), on_progress=show, on_step=look)
        one.records.start()
        try:
            run_stages(short_pipeline, one)
        except _Enough:
            one.next_stage(one.stage_index + 1)
            run_stages(short_pipeline, one)
    trained, done, _ = reports[-1]
    course = [seconds for _, _, seconds in reports]
    during = (trained - began - done * fmean(course)) * steps / done
    course += [course[-1]] * (round(len(course) * steps / done) - len(course))
    return Rehearsal(steps, course, max(0.0, during), time.perf_counter() - trained)


def fewest(pipeline: Pipeline) -> int:
    """Return the fewest steps that the training is cut to: its edits keep apart, and a rehearsal has as many."""
    training = pipeline.settings.training
    return max(min(STEPS, training.rehearsed), min_steps(training))


def new_run(run: Run, pipeline: Pipeline, **changes: Any) -> Run:
    """Return a run of the pipeline as this one was before its first step, with its device, scene and photographs."""
    own: dict[str, Any] = {
        "best": None,
        "best_tables": {},
        "scalars": {},
        "model_hashes": {},
        "metrics": {},
        "changes": [],
    }
    return replace(run, settings=pipeline.settings, pipeline=pipeline.resolved(), **own, **changes)


def _reporting(settings: PipelineFile) -> PipelineFile:
    """The settings with REPORTS reports of the training, or more."""

    def often(training: Training) -> Training:
        return training.model_copy(update={"log_every": min(training.log_every, -(-training.steps // REPORTS))})

    return map_trainings(settings, Training, often)


def _require_one_training(pipeline: Pipeline) -> None:
    """Raise ConfigError where the time of the training does not follow from one number of steps."""
    trainings = [stage for stage in pipeline.stages if isinstance(stage, Training)]
    if len(trainings) != 1:
        raise ConfigError(
            f"{pipeline.path}: --minutes: expected one stage that trains, found {len(trainings)}; leave --minutes out"
        )
    if isinstance(trainings[0], Keeping) and trainings[0].refit:
        raise ConfigError(
            f"{pipeline.path}: --minutes: a refit trains twice, for an unknown time; add --set optimize.refit=false"
        )


def _too_few(minutes: float, pipeline: Pipeline) -> ConfigError:
    return ConfigError(
        f"--minutes {minutes:g}: too few for this scene on this device, where {fewest(pipeline)} steps are the fewest; "
        "give more minutes, or smaller photographs (--set scene.downscale=2)"
    )
