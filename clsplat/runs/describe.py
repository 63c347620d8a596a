"""Describe what a run would do, without running it."""

import logging
from collections.abc import Sequence
from pathlib import Path

from clsplat.core import lock
from clsplat.core.errors import DataError, pluralize
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline
from clsplat.runs.estimate import estimate_time
from clsplat.runs.opening import (
    ReadScene,
    check_start,
    expect_measures,
    list_photo_names,
    open_run,
    read_run_scene,
    resolve_choices,
)
from clsplat.runs.outputs import check_output_paths
from clsplat.runs.run_folder import Start, check_run_folder, choose_start
from clsplat.runs.runner import check_run, restore
from clsplat.runs.state import RunState
from clsplat.scene.quality import Measures
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.init import Init
from clsplat.stages.render import Render
from clsplat.training.memory import offload_target, table_widths
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled, Stage, Training

LOG = logging.getLogger("clsplat")


def describe(
    pipeline: Pipeline,
    state: RunState,
    device: str | Device | None,
    start: Start,
    read: ReadScene = read_run_scene,
    with_time: bool = False,
) -> str:
    """Describe what a run would do in a folder, one line per stage, without writing anything.

    read: function that reads the scene.  with_time: whether to add a time estimate for a new run.
    Raises the errors that the run would raise before its first stage.  Photos are checked only after the preparation.
    """
    out = state.out
    actual_start = choose_start(pipeline, state, start)
    if actual_start is None:
        return f"{out}: up to date"
    start = actual_start
    check_output_paths(pipeline, state)
    check_run_folder(state, start)
    check_unused(out)
    planned_steps = pipeline.preparation(out)
    lines = [f"  {step.step.stage:<14} {step.reason or 'done'}" for step in planned_steps]
    run, verdict = None, "would run"
    if any(step.reason for step in planned_steps):
        opened_device, _ = check_start(pipeline, out, device, start)
    else:
        run = open_run(pipeline, out, device, start, read=read)
        opened_device = run.device
        pipeline = resolve_choices(pipeline, run, log_reasons=False)  # the description includes them
        if start == "resume":
            restored_checkpoint = restore(pipeline, run)
            verdict = f"would continue from step {run.step}" if restored_checkpoint else "nothing to resume; would run"
        check_run(pipeline, run)
    names = list_photo_names(pipeline, planned_steps, out) if run is None else []
    measures, refusal_lines = _expect_measures(pipeline, names)
    lines += [*refusal_lines, *(f"  adapt          {reason}" for reason in pipeline.reasons)]
    if undecided_keys := pipeline.undecided:
        lines.append(f"  adapt          chosen from the photos: {', '.join(undecided_keys)}")
    active_stages = [stage for stage in pipeline.stages if _has_work(stage, run)]
    lines += [f"  {stage.stage:<14} {_describe_stage(stage, run)}".rstrip() for stage in active_stages]
    lines += _describe_offloading(pipeline, run) if run else []
    if with_time and start != "resume":
        lines += estimate_time(pipeline, planned_steps, names, measures, opened_device, run)
    return f"{verdict} in {out}:\n" + "\n".join(lines)


def _expect_measures(pipeline: Pipeline, names: Sequence[str]) -> tuple[Measures | None, list[str]]:
    """Return the expected measures of the photos to prepare, and lines of text.

    If the run would be refused even with a camera for every photo, the measures are None, and a line gives the reason.
    """
    try:
        return expect_measures(pipeline, names), []
    except DataError as error:
        return None, [f"  photos         even if all {len(names)} photos get a camera, the run is refused: {error}"]


def check_unused(out: Path) -> None:
    """Raise OutputError if a run is using `out`.  Log a line if a new run would have to wait for a heartbeat."""
    if not lock.check_free(out):
        LOG.info(
            "%s: was recently in use on another machine; the run would wait up to a minute for a heartbeat from there",
            out,
        )


def _describe_offloading(pipeline: Pipeline, run: Run) -> list[str]:
    """Return a list with a line on memory if the spherical harmonics are offloaded to the host, else an empty list."""
    init_stage = next((stage for stage in pipeline.stages if isinstance(stage, Init)), None)
    if init_stage is None:
        return []
    motion, gaussian_count = run.model_settings.time, init_stage.expected_count(run.scene)
    tables = table_widths(run.model_settings.sh_degree, motion.width if motion else 0)
    if run.harmonics == "auto" and gaussian_count <= run.memory_plan(tables, "device").limit:
        return []
    host_plan = run.memory_plan(tables, offload_target(run.harmonics, run.device.info))
    return [f"  {host_plan.text(gaussian_count)}"] if host_plan.host else []


def _has_work(stage: Stage, run: Run | None) -> bool:
    """Return whether a stage does anything.  Evaluation and rendering do nothing if their split has no views."""
    return not (isinstance(stage, Evaluate | Render) and run) or bool(run.original.split(stage.split))


def _describe_stage(stage: Stage, run: Run | None) -> str:
    if isinstance(stage, Training):
        return f"{stage.steps} steps; " + ", ".join(map(_describe_cadence, stage.during))
    if isinstance(stage, Evaluate) and run:
        views = run.original.downscaled(run.downscale).split(stage.split)
        sizes = ", ".join(f"1/{downscale:g}" for downscale in stage.downscales or [run.downscale])
        return f"{pluralize(len(views), f'{stage.split} view')} at {sizes}"
    return ""


def _describe_cadence(stage: Scheduled) -> str:
    """Describe when a scheduled stage runs, such as "densify every 100 (start 500, stop 15000)"."""
    conditions = {name: getattr(stage, name, None) for name in ("start", "stop", "when_background")}
    text = ", ".join(f"{name} {value}" for name, value in conditions.items() if value)
    return f"{stage.stage} every {stage.every}" + (f" ({text})" if text else "")
