"""Choose the number of steps that fit into a time budget (`--minutes`).

A short rehearsal measures the time of a training step and the time of everything else.  If it takes only a small
fraction of the budget, a longer one follows, because steps become slower as the number of Gaussians grows.  At fixed
fractions of the training, the number of steps is corrected from measured times.  The run's pipeline contains the number
of steps, so that the run can be reproduced bit by bit.
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
from clsplat.pipeline.stretching import last_edit, map_trainings, min_steps, stretch, with_steps
from clsplat.runs.run_folder import Start
from clsplat.runs.runner import check_run, run_stages, write_pipeline
from clsplat.stages.optimize import ValidatedTraining
from clsplat.training.run import Run
from clsplat.training.stage import Training
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")
CORRECTIONS = 0.3, 0.6, 0.85  # fractions of the training
STEPS = 200  # of the first rehearsal; a training stage may declare a smaller number
STEP_FACTOR = 3  # factor by which the next rehearsal has more steps
MIN_FRACTION = 0.03  # of the budget; a shorter rehearsal is followed by a longer one
REPORTS = 20  # minimum number per training; each contains the median time of the steps since the previous one
MAX_FRACTION = 0.2  # of the budget; after this time, a rehearsal stops training
MAX_TREND = 0.5  # largest exponent of the growth of a step's time with the number of steps

Show = Callable[[Progress], None]
Execute = Callable[[Pipeline, Run, Start, Show], None]


@dataclass(frozen=True)
class Rehearsal:
    """The measured times of a pipeline run with few steps, in seconds."""

    steps: int
    step_times: Sequence[float]  # mean time of one step in each of several equal parts of the training
    overhead: float  # before the training, and between its steps
    after: float  # after the training
    trend: float = 0.0  # exponent of the growth of a step's time with the number of steps

    def steps_in(self, seconds: float) -> int:
        """Return the number of training steps that fit into a total time, s."""
        times = max(0.0, seconds - self.overhead - self.after) / (self.steps * fmean(self.step_times))
        return math.floor(self.steps * math.pow(times, 1 / (1 + self.trend)))

    def later_step_times(self, fraction: float) -> tuple[float, float]:
        """Return the mean and final step time after a fraction of training, relative to the step time at that point."""
        index = min(int(fraction * len(self.step_times)), len(self.step_times) - 1)
        current = self.step_times[index]
        return fmean(self.step_times[index:]) / current, self.step_times[-1] / current


class _RehearsalOver(Exception):
    """Raised to end the training of a rehearsal early."""


def execute_within(minutes: float, pipeline: Pipeline, run: Run, start: Start, show: Show, execute: Execute) -> None:
    """Execute the pipeline with the number of steps that fits into `minutes`, including the rehearsal.

    Raises ConfigError unless exactly one stage trains and its minimum number of steps fits.  Also raises the errors of
    `execute`.
    """
    deadline = time.perf_counter() + 60 * minutes
    _require_single_training(pipeline)
    check_run(pipeline, run)
    rehearsal = rehearse_enough(pipeline, run, minutes, deadline)
    steps, planned_steps = pipeline.settings.training.steps, rehearsal.steps_in(deadline - time.perf_counter())
    if planned_steps < min_training_steps(pipeline):
        raise _too_short_error(minutes, pipeline)
    reason = f"--minutes {minutes:g}: {planned_steps:,} steps instead of {steps:,}, based on a rehearsal"
    LOG.info("%s", reason)
    settings = _add_reports(stretch(pipeline.settings, Fraction(planned_steps, steps)))
    plan = replace(pipeline, settings=settings, reason=reason)

    def correct(plan: Pipeline, report: Progress) -> Pipeline:
        old_steps, fraction, step_time = report.steps, report.step / report.steps, report.milliseconds / 1e3
        mean_step_time, last_step_time = (ratio * step_time for ratio in rehearsal.later_step_times(fraction))
        remaining = rehearsal.after + (1 - fraction) * rehearsal.overhead + mean_step_time * (old_steps - report.step)
        change = math.floor((deadline - time.perf_counter() - remaining) / last_step_time)
        # stages that start after the last edit run once
        minimum = min(old_steps, last_edit(plan.settings.training) + 2)
        steps = max(report.step + 2, minimum, old_steps + change)
        reason = f"--minutes {minutes:g}: {steps:,} steps, corrected at step {report.step:,}"
        LOG.info("%s; %.0f ms per step", reason, report.milliseconds)
        return replace(plan, settings=with_steps(plan.settings, steps, report.step), reason=reason)

    for fraction in CORRECTIONS:
        corrected_plan = _execute_until(fraction, plan, new_run(run, plan), start, show, execute, correct)
        if corrected_plan is None:
            return
        plan, start = corrected_plan, "resume"
    execute(plan, new_run(run, plan), start, show)


def _execute_until(
    fraction: float,
    plan: Pipeline,
    run: Run,
    start: Start,
    show: Show,
    execute: Execute,
    correct: Callable[[Pipeline, Progress], Pipeline],
) -> Pipeline | None:
    """Execute a pipeline up to a fraction of its training, save a checkpoint, and return the corrected pipeline.

    Returns None if the training ended before that fraction.
    """
    corrected_plans: list[Pipeline] = []

    def show_and_correct(report: Progress) -> None:
        show(report)
        if fraction * report.steps <= report.step < report.steps and not run.interrupted:
            corrected_plans.append(correct(plan, report))
            write_pipeline(corrected_plans[0], run)  # before the checkpoint, so that a resumed run uses it
            run.settings, run.pipeline = corrected_plans[0].settings, corrected_plans[0].resolved_settings()
            run.interrupted = True

    try:
        execute(plan, run, start, show_and_correct)
    except Interrupted:
        if not corrected_plans:
            raise
        stop_if_signaled()
    return corrected_plans[0] if corrected_plans else None


def rehearse_enough(pipeline: Pipeline, run: Run, minutes: float, deadline: float) -> Rehearsal:
    """Repeat the rehearsal with more steps until it takes a minimum fraction of the budget.  Return the last rehearsal.

    The result includes the trend of step times.  deadline: on the clock of `time.perf_counter`, s.  Raises the errors
    of `rehearse`.
    """
    steps, start_time, trend = min(STEPS, pipeline.settings.training.rehearsal_steps), time.perf_counter(), 0.0
    rehearsal = rehearse(pipeline, run, steps, minutes, deadline)
    while time.perf_counter() - start_time < MIN_FRACTION * 60 * minutes:
        previous, steps, start_time = rehearsal, STEP_FACTOR * steps, time.perf_counter()
        rehearsal = rehearse(pipeline, run, steps, minutes, deadline)
        trend = math.log(fmean(rehearsal.step_times) / fmean(previous.step_times)) / math.log(STEP_FACTOR)
    return replace(rehearsal, trend=min(max(trend, -MAX_TREND), MAX_TREND))


def rehearse(pipeline: Pipeline, run: Run, steps: int, minutes: float, deadline: float) -> Rehearsal:
    """Run all stages of the pipeline with few steps, without changing the run.

    deadline: on the clock of `time.perf_counter`, s.  Raises ConfigError as soon as it is clear that the minimum number
    of steps does not fit.
    """
    LOG.info("--minutes %g: timing %s with %d steps", minutes, pipeline.settings.name, steps)
    short_settings = stretch(pipeline.settings, Fraction(steps, pipeline.settings.training.steps))
    short_pipeline, start_time = replace(pipeline, settings=_add_reports(short_settings)), time.perf_counter()
    reports: list[tuple[float, int, float]] = []  # time on the clock, s; step; time of one step, s

    def check_time() -> None:
        # the first report may include the time to build the kernels
        step_time = min(seconds for _, _, seconds in reports[-2:]) if len(reports) > 1 else 0.0
        if time.perf_counter() + min_training_steps(pipeline) * step_time > deadline:
            raise _too_short_error(minutes, pipeline)

    def show(report: Progress) -> None:
        run.status.count("steps", report.step, report.steps)
        reports.append((time.perf_counter(), report.step, report.milliseconds / 1e3))
        check_time()
        if report.step < report.steps and reports[-1][0] - reports[0][0] > MAX_FRACTION * 60 * minutes:
            raise _RehearsalOver

    run.status.note(seconds_left=None)
    with scratch_folder(run.out / "rehearsal") as out, log_level(logging.WARNING), run.status.stage("rehearse"):
        trial = new_run(run, short_pipeline, out=out, status=StatusFile(out), on_progress=show, on_step=check_time)
        trial.records.start()
        try:
            run_stages(short_pipeline, trial)
        except _RehearsalOver:
            trial.next_stage(trial.stage_index + 1)
            run_stages(short_pipeline, trial)
    training_end, completed_steps, _ = reports[-1]
    step_times = [seconds for _, _, seconds in reports]
    overhead = (training_end - start_time - completed_steps * fmean(step_times)) * steps / completed_steps
    step_times += [step_times[-1]] * (round(len(step_times) * steps / completed_steps) - len(step_times))
    return Rehearsal(steps, step_times, max(0.0, overhead), time.perf_counter() - training_end)


def min_training_steps(pipeline: Pipeline) -> int:
    """Return the minimum number of training steps: that of a rehearsal, or more if edits would coincide."""
    training = pipeline.settings.training
    return max(min(STEPS, training.rehearsal_steps), min_steps(training))


def new_run(run: Run, pipeline: Pipeline, **changes: Any) -> Run:
    """Return an unstarted run of another pipeline, with the device, scene, and photos of `run`."""
    reset: dict[str, Any] = {
        "best": None,
        "best_tables": {},
        "scalars": {},
        "model_hashes": {},
        "metrics": {},
        "changes": [],
    }
    return replace(run, settings=pipeline.settings, pipeline=pipeline.resolved_settings(), **reset, **changes)


def _add_reports(settings: PipelineFile) -> PipelineFile:
    """Return settings in which each training run writes at least REPORTS reports."""

    def with_reports(training: Training) -> Training:
        return training.model_copy(update={"log_every": min(training.log_every, -(-training.steps // REPORTS))})

    return map_trainings(settings, Training, with_reports)


def _require_single_training(pipeline: Pipeline) -> None:
    """Raise ConfigError unless a single number of steps determines the time of the training."""
    stages = [stage for stage in pipeline.stages if isinstance(stage, Training)]
    if len(stages) != 1:
        raise ConfigError(
            f"{pipeline.path}: --minutes: expected one stage that trains, found {len(stages)}; omit --minutes"
        )
    if isinstance(stages[0], ValidatedTraining) and stages[0].refit:
        raise ConfigError(
            f"{pipeline.path}: --minutes: a refit trains twice, for an unknown time; add --set optimize.refit=false"
        )


def _too_short_error(minutes: float, pipeline: Pipeline) -> ConfigError:
    return ConfigError(
        f"--minutes {minutes:g}: too short for the minimum of {min_training_steps(pipeline)} steps on this device; "
        "use more minutes, or smaller images (--set scene.downscale=2)"
    )
