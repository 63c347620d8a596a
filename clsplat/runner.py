"""Running a pipeline: the run folder, the device, the scene, the stages in order, and what is left behind."""

import json
import logging
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

from clsplat.errors import ClsplatError, ConfigError, Interrupted, OutputError
from clsplat.files import unwritable, write_text
from clsplat.opencl.device import Device, choose
from clsplat.pipeline import Pipeline, load, prepared_beside
from clsplat.prepare.cache import NOTE, Planned, note, noted, prepare
from clsplat.render.rasterizer import Rasterizer
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
        raise ConfigError(f"{out}: already holds a run; --resume goes on with it, or give another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(out, error) from error
    write_text(out / "status.json", json.dumps({"state": "starting"}) + "\n")


def give_up(out: Path, error: ClsplatError) -> None:
    """Say in the run folder's status.json why nothing was run."""
    Records(out).status("failed", 0, exit_code=error.exit_code, message=str(error))


def free_folder(folder: Path, pipeline: Pipeline | None, resume: bool) -> Path:
    """The default run folder: a number keeps a new run apart from earlier ones, but for a finished one of the same."""
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
    try:
        done = json.loads((out / "status.json").read_text())["state"] == "done"
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return done and load(str(out / "pipeline.yaml")).resolved() == pipeline.resolved()


def open_run(pipeline: Pipeline, out: Path, words: str | None) -> Run:
    """Choose the device and read the scene.  Raises what they raise."""
    settings = pipeline.settings
    for stage in pipeline.stages:
        stage.check()
    device = Device(choose(words), settings.rasterizer.schedule)
    LOG.info("device: %s", device.text)
    planned = pipeline.preparation(out)
    if planned and noted(out) not in (None, note(planned)):
        raise ConfigError(f"{out}: began with other photographs, or other settings to prepare them; give another --out")
    original, background = settings.scene.read(prepare(planned, settings.scene.folder, prepared_beside(out)))
    scene = original.downscaled(*settings.scene.scales)
    camera, budget = scene.views[0].camera, settings.scene.image_budget
    LOG.info(
        "scene: %s, %d training and %d test views, %d x %d px, %s background, extent %.3g",
        *(scene.path, len(scene.train), len(scene.test), camera.width, camera.height, background, scene.extent),
    )
    return Run(
        device=device,
        scene=scene,
        original=original,
        out=out,
        name=settings.name,
        seed=settings.seed,
        pipeline=pipeline.resolved(),
        rasterizer=Rasterizer(device, settings.rasterizer.sort, settings.rasterizer.budget()),
        photographs=Photographs(device, background, None if budget is None else budget << 20, out / "undistorted"),
        model_settings=settings.model,
        prepared=note(planned) if planned else None,
    )


def execute(pipeline: Pipeline, run: Run, resume: bool, show: Callable[[Progress], None]) -> None:
    """Run the stages, from the newest checkpoint when resuming, and write what the run folder promises."""
    run.show = show
    resumed = resume and checkpoint.restore(run)
    if resume:
        LOG.info("resumed at step %d" if resumed else "nothing to resume; starting from the beginning%.0s", run.step)
    write_text(run.out / "pipeline.yaml", f"# resolved from {pipeline.path.name}\n{pipeline.text()}")
    if run.prepared:
        write_text(run.out / NOTE, json.dumps(run.prepared) + "\n")
    run.records.start(run.step, edit_due=run.stage_step > 0)
    try:
        with _finishing_on_interrupt(run):
            _run_stages(pipeline, run)
        _write_metrics(run)
        _check_outputs(pipeline, run)
    except ClsplatError as error:
        state = "interrupted" if isinstance(error, Interrupted) else "failed"
        run.records.status(state, run.step, exit_code=error.exit_code, message=str(error))
        raise
    run.records.status("done", run.step, exit_code=0)


def _run_stages(pipeline: Pipeline, run: Run) -> None:
    for cursor, stage in enumerate(pipeline.stages):
        if cursor < run.cursor:
            continue
        if cursor > run.cursor:
            run.cursor, run.stage_step = cursor, 0
        stage.run(run)
        if run.interrupted:
            path = checkpoint.save(run, keep=2)
            raise Interrupted(f"stopped after {stage.stage}, saved in {path}; --resume goes on from there")


@contextmanager
def _finishing_on_interrupt(run: Run) -> Iterator[None]:
    """Ctrl-C and SIGTERM let the step finish and the state be saved; a second one stops at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def finish(number: int, frame: FrameType | None) -> None:
        if run.interrupted:
            raise KeyboardInterrupt
        LOG.info("finishing the step; press Ctrl-C again to stop at once")
        run.interrupted = True

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, finish) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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
    """A run that did not write what it declared has failed."""
    promised = ["metrics.json", "pipeline.yaml"]
    promised += [stage.file for stage in pipeline.stages if isinstance(stage, Export)]
    for name in promised:
        path = run.out / name
        if not path.is_file() or path.stat().st_size == 0:
            raise OutputError(f"{path}: was to be written but is missing or empty; see {run.out / 'log.txt'}")


def describe(pipeline: Pipeline, out: Path, device: str | None) -> str:
    """What a run in `out` would do, a line for each stage.  Raises what open_run raises, once photographs are ready."""
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
            views = run.original.downscaled(run.scale).split(stage.split)
            scales = ", ".join(f"1/{scale:g}" for scale in stage.scales or [run.scale])
            detail = f"{len(views)} {stage.split} views at {scales}"
        lines.append(f"  {stage.stage:<14} {detail}".rstrip())
    return f"would run in {out}:\n" + "\n".join(lines)
