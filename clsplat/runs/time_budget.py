"""The number of steps that fit into a time.

The pipeline is rehearsed in few steps, and what that took is continued.  How many Gaussians grow is only known when
they have grown; then the number is corrected.  It is written into the run's pipeline, so that its bits repeat.
"""

import logging
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from statistics import fmean
from typing import Any

from clsplat.core.errors import ConfigError, Interrupted
from clsplat.core.files import scratch_folder
from clsplat.core.progress import Progress, only
from clsplat.core.signals import stop_if_signalled
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.stretching import fewest_steps, last_edit, of_trainings, stretched, with_steps
from clsplat.runs.run_folder import Start
from clsplat.runs.runner import check_in, run_stages, write_pipeline
from clsplat.stages.optimize import Keeping
from clsplat.training.run import Run
from clsplat.training.stage import Training
from clsplat.training.status import StatusFile

# What a pipeline took in few steps, and what that tells of more of them.

TREND = 0.5  # steepest power of the number of steps that the time of one is taken to follow
EARLY, SOON = 0.25, 0.6  # shares of the training between which it is corrected, where growth ends
TWICE = 0.4, 0.8  # where growth ends later
FEW = 200  # steps, where the search for their number begins


@dataclass(frozen=True)
class Rehearsal:
    """What a pipeline took in few steps."""

    steps: int
    course: Sequence[float]  # s, a training step, in each of equal parts of the training
    during: float  # s, of edits and measurements of the training: the same in any number of steps
    after: float  # s, of what follows the training
    growth: float  # the share of the steps after which no Gaussian grew

    @property
    def known(self) -> Sequence[float]:
        """The shares of the training at which the number of steps is corrected: where growth ends, if that is soon."""
        return [max(EARLY, self.growth)] if self.growth <= SOON else TWICE

    @property
    def step(self) -> float:
        """The mean time of a step, s."""
        return fmean(self.course)

    def later(self, share: float) -> tuple[float, float]:
        """How many times as long as at a share of the training steps take after it, in the mean and at the end."""
        place = min(int(share * len(self.course)), len(self.course) - 1)
        after = self.course[place + 1 :] or self.course[-1:]
        return fmean(after) / self.course[place], self.course[-1] / self.course[place]


def predicted(rehearsals: Sequence[Rehearsal], steps: int) -> float:
    """Return the time of a number of steps, in s, from rehearsals in growing numbers of steps.

    The time of a step is a power of their number, as the last two rehearsals have it: a model that trains longer has
    more Gaussians, and smaller ones.
    """
    *_, last = rehearsals
    power = 0.0
    if len(rehearsals) > 1:
        before = rehearsals[-2]
        power = math.log(last.step / before.step) / math.log(last.steps / before.steps)
        power = min(max(power, -TREND), TREND)
    return last.during + last.after + steps * last.step * math.pow(steps / last.steps, power)


def most_steps(rehearsals: Sequence[Rehearsal], seconds: float) -> int:
    """Return the largest number of steps that are predicted to take no longer than `seconds`; 0 where none is."""
    low, high = 0, FEW
    while predicted(rehearsals, high) <= seconds:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if predicted(rehearsals, middle) <= seconds else (low, middle)
    return low


# Rehearsing a pipeline in few steps, for no longer than it tells something.

LOG = logging.getLogger("clsplat")
REPORTS = 20  # of a rehearsal; each gives the median time of its steps, without what is done once
TELLING = 3  # of them, at least, that tell what a step takes
LONGEST = 0.2  # of the whole time, that the steps of a rehearsal may take: then the rest is taken to be like the last


@dataclass(frozen=True)
class Limit:
    """The time that a rehearsal and the run after it have together."""

    minutes: float
    until: float  # s, on the clock
    fewest: int  # steps of the run

    def require(self, end: float) -> None:
        """Raise ConfigError where the run cannot end before `end`, s on the clock, which is too late."""
        if end > self.until:
            raise too_little(self.minutes, self.minutes + (end - self.until) / 60, self.fewest)


def too_little(minutes: float, least: float, fewest: int) -> ConfigError:
    """Return the error of a time that is too short; least: minutes that would do, as far as is known."""
    told = f"in which {fewest} steps fit, the fewest of this pipeline"
    expected = f"expected {math.ceil(10 * least) / 10:g} or more for this scene on this device, {told}"
    return ConfigError(f"--minutes {minutes:g}: {expected}; or a pipeline that does less")


class _Enough(Exception):
    """Ends the steps of a rehearsal."""


@dataclass
class Watch:
    """Looks at the clock while a pipeline is rehearsed: ends its steps, or all of it, where it takes too long."""

    limit: Limit
    run: Run  # whose pipeline it is
    status: StatusFile  # of the rehearsal
    training: str  # name of the stage
    began: float = field(default_factory=time.perf_counter)  # s, on the clock
    done: int = 0  # steps
    course: list[float] = field(default_factory=list)  # s, a step of each report
    trained: float = 0.0  # s, on the clock, at the last report
    spent: dict[str, float] = field(default_factory=dict)  # s, of other stages, up to it

    def look(self) -> None:
        """Raise ConfigError where what has been done so far, done again with the fewest steps, ends too late."""
        each = min(self.course[-2:]) if len(self.course) > 1 else 0.0  # one may be of a step that builds kernels
        again = sum(self._spent().values()) + self.limit.fewest * each
        self.limit.require(time.perf_counter() + again)

    def show(self, progress: Progress) -> None:
        """Take a report.  Raises _Enough where the steps have taken their time, and what `look` raises."""
        self.run.status.count("steps", progress.step, progress.steps)
        self.trained, self.done, self.spent = time.perf_counter(), progress.step, self._spent()
        self.course.append(progress.milliseconds / 1e3)
        self.look()
        steps = self.trained - self.began - sum(self.spent.values())
        tells = len(self.course) >= TELLING and progress.step < progress.steps
        if tells and steps > LONGEST * 60 * self.limit.minutes:
            raise _Enough

    def _spent(self) -> dict[str, float]:
        return {name: seconds for name, seconds in self.status.seconds.items() if name != self.training}


def rehearse(pipeline: Pipeline, run: Run, factor: Fraction, limit: Limit) -> Rehearsal:
    """Run all stages of the pipeline in `factor` times its steps, or fewer of these; the run is left as it is.

    Raises ConfigError as soon as it is known that the limit is too short.
    """
    short = replace(pipeline, settings=reporting(stretched(pipeline.settings, factor)))
    training = short.settings.training
    with scratch_folder(run.out / "rehearsal") as out, only(logging.WARNING):
        watch = Watch(limit, run, StatusFile(out), training.stage)
        one = new_run(run, short, out=out, status=watch.status, show=watch.show, between=watch.look)
        one.records.start()
        try:
            run_stages(short, one)
        except _Enough:
            one.next_stage(one.cursor + 1)
            run_stages(short, one)
        after = time.perf_counter() - watch.trained
        growth = [line["step"] for line in one.records.read("densify") if any(line["grown"].values())]
    is_whole, full = watch.done == training.steps, pipeline.settings.training
    during = sum(s * _times(name, full, training, watch.done) for name, s in watch.spent.items())
    parts = math.ceil(training.steps / training.log_every)
    course = [*watch.course, *[watch.course[-1]] * (parts - len(watch.course))]
    known = max(growth, default=0) / training.steps if is_whole else 1.0
    return Rehearsal(training.steps, course, during, after, known)


def _times(name: str, full: Training, short: Training, done: int) -> float:
    """How often stages of a name act in a training for each time that they did in the steps of a short one that are
    done; 1 for those that act at each step, or before the training."""
    found = [stage for stage in full.during if stage.stage == name]
    if any(stage.every == 1 for stage in found):
        return 1.0
    wanted = sum(stage.due(step) for stage in found for step in range(1, full.steps + 1))
    acted = sum(stage.due(step) for stage in short.during if stage.stage == name for step in range(1, done + 1))
    return wanted / acted if acted else 1.0


def new_run(run: Run, pipeline: Pipeline, **changes: Any) -> Run:
    """Return a run of the pipeline as this one was before its first step, with its device, scene and photographs."""
    own: dict[str, Any] = {"best": None, "best_tables": {}, "numbers": {}, "written": {}, "metrics": {}, "changes": []}
    return replace(run, settings=pipeline.settings, pipeline=pipeline.resolved(), **own, **changes)


def reporting(settings: PipelineFile) -> PipelineFile:
    """With REPORTS reports of each training, or more: one is needed soon after each share at which it is corrected."""

    def often(training: Training) -> Training:
        return training.model_copy(update={"log_every": min(training.log_every, -(-training.steps // REPORTS))})

    return of_trainings(settings, Training, often)


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
        told = "a refit trains twice, for nobody knows how long; add --set optimize.refit=false"
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
