"""Run a pipeline: the run folder, the device, the scene, the stages in order, and the output files."""

import json
import logging
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError, Interrupted, OutputError, as_clsplat_error, one_line
from clsplat.files import unwritable, write_text
from clsplat.opencl.device import Device, open_device
from clsplat.pipeline.loading import Pipeline, load, prepared_folder
from clsplat.prepare.cache import NOTE, Planned, note, noted, prepare
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import Scene
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.export import Export
from clsplat.stages.optimize import Optimize
from clsplat.training import checkpoint
from clsplat.training.records import Records
from clsplat.training.run import Progress, Run
from clsplat.views.photographs import Photographs

LOG = logging.getLogger("clsplat")


def make_run_folder(out: Path, resume: bool) -> None:
    """Make the run folder.  Raises ConfigError when it holds another run, OutputError when it cannot be written."""
    if (out / "pipeline.yaml").exists() and not resume:
        raise ConfigError(f"{out}: already holds a run; resume it, or give another folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(out, error) from error
    Records(out).status("starting", 0)


@contextmanager
def failures_recorded(out: Path, step: Callable[[], int] | None = None, as_raised: bool = False) -> Iterator[None]:
    """Turn every failure of the block into a ClsplatError, and write it to status.json.

    Without `step` the step is that of the status before; with `as_raised` the failure itself is raised.
    """
    try:
        yield
    except BaseException as error:
        failure = as_clsplat_error(error)
        state = "interrupted" if isinstance(failure, Interrupted) else "failed"
        with suppress(OutputError):  # the failure itself is more important
            at = step() if step else int(read_status(out).get("step", 0))
            Records(out).status(state, at, exit_code=failure.exit_code, message=one_line(failure))
        if failure is error or as_raised:
            raise
        raise failure from error


def read_status(out: Path) -> dict[str, Any]:
    """Return the contents of status.json; an empty dict when it is missing or damaged."""
    try:
        status = json.loads((out / "status.json").read_text())
    except (OSError, ValueError):
        return {}
    return status if isinstance(status, dict) else {}


def free_folder(folder: Path, pipeline: Pipeline | None, resume: bool) -> Path:
    """Return the default run folder: with the next free number, unless a run is resumed or up to date."""
    number, free = 1, folder
    planned = pipeline.preparation(folder) if pipeline else []
    while (free / "pipeline.yaml").exists() and not resume and not (pipeline and up_to_date(pipeline, planned, free)):
        number += 1
        free = folder.with_name(f"{folder.name}-{number}")
    return free


def up_to_date(pipeline: Pipeline, planned: Sequence[Planned], out: Path) -> bool:
    """Whether `out` holds a finished run of this pipeline and the same photographs; never where nothing is prepared."""
    if not planned or noted(out) != note(planned):
        return False
    return (
        read_status(out).get("state") == "done" and load(str(out / "pipeline.yaml")).resolved() == pipeline.resolved()
    )


def open_run(pipeline: Pipeline, out: Path, device: str | Device | None) -> Run:
    """Open the device, prepare and read the scene.  Raises the errors of these steps."""
    settings = pipeline.settings
    for stage in pipeline.stages:
        stage.check()
    opened = open_device(device, settings.rasterizer.schedule)
    LOG.info("device: %s", opened.text)
    planned = pipeline.preparation(out)
    if planned and noted(out) not in (None, note(planned)):
        raise ConfigError(
            f"{out}: was started with other photographs, or other settings of `prepare`; give another folder"
        )
    folder = prepare(planned, settings.scene.folder, prepared_folder(out))
    run = make_run(pipeline, read_scene(folder, settings.scene.holdout), opened, out)
    run.prepared = note(planned) if planned else None
    return run


def make_run(pipeline: Pipeline, scene: Scene, device: Device, out: Path) -> Run:
    """Return a run of the pipeline on a scene, before its first stage."""
    settings = pipeline.settings
    original, background = settings.scene.applied(scene)
    downscaled, budget = original.downscaled(*settings.scene.downscales), settings.scene.image_budget
    camera = downscaled.views[0].camera
    LOG.info(
        "scene: %s, %d training and %d test views, %d x %d px, %s background, extent %.3g",
        *(
            scene.path,
            len(downscaled.train),
            len(downscaled.test),
            camera.width,
            camera.height,
            background,
            downscaled.extent,
        ),
    )
    return Run(
        device=device,
        scene=downscaled,
        original=original,
        out=out,
        name=settings.name,
        seed=settings.seed,
        pipeline=pipeline.resolved(),
        rasterizer=Rasterizer(device, settings.rasterizer.sort, settings.rasterizer.budget()),
        photographs=Photographs(device, background, None if budget is None else budget << 20, out / "undistorted"),
        model_settings=settings.model,
    )


def execute(pipeline: Pipeline, run: Run, resume: bool, show: Callable[[Progress], None]) -> None:
    """Run the stages, from the newest checkpoint with `resume`, and write the files of the run folder."""
    run.show = show
    begin(pipeline, run, resume)
    with failures_recorded(run.out, lambda: run.step):
        with _finishing_on_interrupt(run):
            _run_stages(pipeline, run)
        _write_metrics(run)
        _check_outputs(pipeline, run)
        run.records.status("done", run.step, exit_code=0)


def begin(pipeline: Pipeline, run: Run, resume: bool) -> None:
    """Take the newest checkpoint when resuming, and write what the run folder holds from the beginning on."""
    resumed = resume and checkpoint.restore(run)
    if resume:
        LOG.info("resumed at step %d" if resumed else "nothing to resume; starting from the beginning%.0s", run.step)
    write_text(run.out / "pipeline.yaml", f"# resolved from {pipeline.path.name}\n{pipeline.text()}")
    if run.prepared:
        write_text(run.out / NOTE, json.dumps(run.prepared) + "\n")
    run.records.start(run.step, edit_due=run.stage_step > 0)


def _run_stages(pipeline: Pipeline, run: Run) -> None:
    for cursor, stage in enumerate(pipeline.stages):
        if cursor < run.cursor:
            continue
        if cursor > run.cursor:
            run.cursor, run.stage_step = cursor, 0
        stage.run(run)
        if run.interrupted:
            path = checkpoint.save(run, keep=2)
            raise Interrupted(f"stopped after {stage.stage}, saved in {path}; resume the run to go on")


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C, SIGTERM and SIGHUP; outside the main thread nothing changes.

    A signal that is ignored, as SIGHUP is under nohup, stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}
    try:
        for number in before:
            signal.signal(number, lambda number, frame: stop())
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _finishing_on_interrupt(run: Run) -> Iterator[None]:
    """Finish the step and save the state at the first signal; stop at once at the second."""

    def finish() -> None:
        if run.interrupted:
            raise KeyboardInterrupt
        LOG.info("finishing the step; press Ctrl-C again to stop at once")
        run.interrupted = True

    with stopping_on_signals(finish):
        yield


def _write_metrics(run: Run) -> None:
    metrics = {
        "test": run.metrics.get("test", {}),
        "train": run.metrics.get("train", {}),
        "gaussians": run.model.gaussians.count,
        "steps": run.step,
        "train_seconds": round(run.train_seconds, 3),
        "seed": run.seed,
        "device": run.device.text,
        "pipeline": run.name,
    }
    write_text(run.out / "metrics.json", json.dumps(metrics, indent=1) + "\n")


def _check_outputs(pipeline: Pipeline, run: Run) -> None:
    """Raise OutputError where a declared file is missing."""
    outputs = ["metrics.json", "pipeline.yaml"]
    outputs += [stage.file for stage in pipeline.stages if isinstance(stage, Export)]
    for name in outputs:
        path = run.out / name
        if not path.is_file() or path.stat().st_size == 0:
            raise OutputError(f"{path}: is missing or empty at the end of the run; see {run.out / 'log.txt'}")


def describe(pipeline: Pipeline, out: Path, device: str | Device | None) -> str:
    """Return a line for each stage of a run in `out`.  Raises the errors of open_run when nothing must be prepared."""
    planned = pipeline.preparation(out)
    if planned and up_to_date(pipeline, planned, out):
        return f"{out}: up to date"
    lines = [f"  {one.step.stage:<14} {one.why or 'done'}" for one in planned]
    run = None if any(one.why for one in planned) else open_run(pipeline, out, device)
    for stage in pipeline.stages:
        detail = ""
        if isinstance(stage, Optimize):
            cadences = (f"{inner.stage} every {inner.every}" for inner in stage.during)
            detail = f"{stage.steps} steps; " + ", ".join(cadences)
        elif isinstance(stage, Evaluate) and run:
            views = run.original.downscaled(run.downscale).split(stage.split)
            sizes = ", ".join(f"1/{downscale:g}" for downscale in stage.scales or [run.downscale])
            detail = f"{len(views)} {stage.split} views at {sizes}"
        lines.append(f"  {stage.stage:<14} {detail}".rstrip())
    return f"would run in {out}:\n" + "\n".join(lines)
