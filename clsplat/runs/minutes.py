"""The number of steps that fit into a time.

The pipeline is rehearsed in few steps, and what that took is continued.  How many Gaussians grow is only known when
they have grown; then the number is corrected.  It is written into the run's pipeline, so that its bits repeat.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from clsplat.errors import ConfigError, Interrupted
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.stretching import fewest_steps, last_edit, stretched, with_steps
from clsplat.progress import Progress
from clsplat.runs.folders import Start
from clsplat.runs.prediction import Rehearsal, most_steps, predicted
from clsplat.runs.rehearsing import Limit, new_run, rehearse, reporting, too_little
from clsplat.runs.runner import check_in, write_pipeline
from clsplat.signals import stop_if_signalled
from clsplat.stages.keeping import Keeping
from clsplat.stages.training import Training
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
FIRST = 200  # steps of the first rehearsal at most; a training says how many of its own are enough
LONGER = 3  # times the steps of one before
COARSE = 4  # times as few steps as the pipeline has make a coarse model (ours)
SHARE = 0.03  # of the time: rehearsals that took less are followed by a longer one

Show = Callable[[Progress], None]
Execute = Callable[[Pipeline, Run, Start, Show], None]


def execute_within(minutes: float, pipeline: Pipeline, run: Run, start: Start, show: Show, execute: Execute) -> None:
    """Execute the pipeline in as many steps as take `minutes`, with their rehearsal.

    Raises ConfigError where not exactly one stage trains, or its fewest steps take longer, and what `execute` raises.
    """
    until = time.perf_counter() + 60 * minutes
    check_in(pipeline, run)
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
        least = min(planned, last_edit(plan.settings.training) + 2)  # and what begins behind it, once
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

    Raises ConfigError where not exactly one stage trains, or, as soon as that is known, its fewest steps take longer.
    """
    trains = sum(isinstance(stage, Training) for stage in pipeline.stages)
    if trains != 1:
        raise ConfigError(f"{pipeline.path}: --minutes: expected one stage that trains, found {trains}; leave it out")
    training = pipeline.settings.training
    if isinstance(training, Keeping) and training.refit:
        made = [f", chosen by {one.reason}" for one in pipeline.settings.choices if "optimize.refit" in one.keys]
        told = f"a refit trains twice, for nobody knows how long{''.join(made)}; add --set optimize.refit=false"
        raise ConfigError(f"{pipeline.path}: --minutes: {told} to train once, or leave --minutes out")
    first, found, took = min(FIRST, training.rehearsed), list[Rehearsal](), 0.0
    limit = Limit(minutes, time.perf_counter() + 60 * minutes, fewest(training))
    run.status.note(seconds_left=None)
    with run.status.stage("rehearse"):
        while took < SHARE * 60 * minutes:
            number, began = first * LONGER ** len(found), time.perf_counter()
            LOG.info("--minutes %g: %s is rehearsed in %d steps", minutes, pipeline.settings.name, number)
            found.append(rehearse(pipeline, run, Fraction(number, training.steps), limit))
            took = time.perf_counter() - began
    return found


def fewest(training: Training) -> int:
    """Return the fewest steps that a training is cut to: its edits keep apart, and a rehearsal has as many at least."""
    return max(min(FIRST, training.rehearsed), fewest_steps(training))


def pipeline_for(pipeline: Pipeline, rehearsals: Sequence[Rehearsal], seconds: float, minutes: float) -> Pipeline:
    """Return the pipeline in as many steps as are predicted to take so many seconds.

    Raises ConfigError where those are fewer than the training may have.
    """
    steps, least = pipeline.settings.training.steps, fewest(pipeline.settings.training)
    number = most_steps(rehearsals, seconds)
    if number < least:
        raise too_little(minutes, minutes + (predicted(rehearsals, least) - seconds) / 60, least)
    told = f"{number:,} steps in the place of {steps:,}, which take about {seconds / 60:.1f} minutes more"
    reason = f"--minutes {minutes:g}: {told}, by a rehearsal in {rehearsals[-1].steps:,} steps"
    LOG.info("%s", reason)
    if COARSE * number < steps:
        whole = minutes + (predicted(rehearsals, steps) - seconds) / 60
        LOG.warning(
            "%s of %s steps make a coarse model: for all of them give --minutes %d, or smaller photographs "
            "(scene.downscale)",
            *(f"{number:,}", f"{steps:,}", math.ceil(whole)),
        )
    return replace(pipeline, settings=reporting(stretched(pipeline.settings, Fraction(number, steps))), reason=reason)
