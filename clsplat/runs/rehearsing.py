"""Rehearsing a pipeline in few steps, for no longer than it tells something."""

import logging
import math
import time
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

from clsplat.errors import ConfigError
from clsplat.files import scratch_folder
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.stretching import of_trainings, stretched
from clsplat.progress import Progress, only
from clsplat.runs.prediction import Rehearsal
from clsplat.runs.runner import run_stages
from clsplat.stages.training import Training
from clsplat.training.run import Run
from clsplat.training.status import StatusFile

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
