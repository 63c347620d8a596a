"""Open what a run needs: the device, the photographs' preparation, the scene."""

from pathlib import Path

from clsplat.conformance.quick import open_correct
from clsplat.errors import ConfigError
from clsplat.names import UNDISTORTED
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, prepared_folder
from clsplat.pipeline.on_host import harmonics_of
from clsplat.pipeline.places import contents
from clsplat.prepare.cache import Planned, note, noted, prepare
from clsplat.prepare.facts import facts
from clsplat.processes import Owner
from clsplat.progress import Listener, heard_by
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.folders import Start
from clsplat.runs.scenes import ReadScene, RunScene, read_run_scene
from clsplat.runs.unprepared import check_preparation
from clsplat.training.run import Run
from clsplat.training.status import StatusFile
from clsplat.views.photographs import Photographs

READ_SCENE = "read_scene"  # the last stage of the preparation


def open_run(
    pipeline: Pipeline,
    out: Path,
    device: str | Device | None,
    start: Start = "new",
    status: StatusFile | None = None,
    read: ReadScene = read_run_scene,
) -> Run:
    """Open the device, prepare and read the scene, decode its photographs, and tell `status` how far that is.

    start: "restart" lets others take the place of the photographs that the run in `out` was started with.
    Raises the errors of these steps.
    """
    opened, planned = check_start(pipeline, out, device, start)
    if status:
        status.enter("preparing", device=opened.text)
    status = status or StatusFile(out)
    folder, root = pipeline.settings.scene.folder, prepared_folder(out)
    with heard_by(counts_of(status)):
        folder = prepare(planned, folder, root, status.stage)
        with status.stage(READ_SCENE):
            run = make_run(pipeline, read(pipeline.settings.scene, folder), opened, out, status)
    run.prepared, run.found = note(planned) if planned else None, facts(planned)
    return run


def counts_of(status: StatusFile) -> Listener:
    """Return what notes counts of the preparation, and the time left in its last stage alone.

    Before that the time of later steps is not known, such as that of finding the cameras while pairs are matched.
    """

    def note_count(what: str, done: int, total: int, /, *, seconds_left: float | None) -> None:
        status.count(what, done, total, seconds_left=seconds_left if status.now.stage == READ_SCENE else None)

    return note_count


def check_start(
    pipeline: Pipeline, out: Path, device: str | Device | None, start: Start
) -> tuple[Device, list[Planned]]:
    """Check all that can be checked before photographs are prepared; return the device and the steps of `prepare`.

    Nothing is written.  Raises the errors of a run.
    """
    settings = pipeline.settings
    for stage in pipeline.stages:
        stage.check()
    opened = open_correct(device, settings.rasterizer.schedule, settings.rasterizer.sort)
    planned = check_preparation(pipeline, out)
    if planned and start != "restart" and noted(out) not in (None, note(planned)):
        raise ConfigError(
            f"{out}: was started with other photographs, or other settings of `prepare`; give another folder"
        )
    return opened, planned


def undistorted_folder(out: Path) -> Path:
    """Return the folder of undistorted photographs: in the run folder, or where a link beside it leads.

    A store puts the link there, so that its cells share them.  Each host has its own, for the names of temporary files
    tell processes of one host apart.
    """
    shared = out.absolute().parent / UNDISTORTED
    return shared / Owner.this().host_word if shared.is_symlink() and shared.is_dir() else out / UNDISTORTED


def make_run(pipeline: Pipeline, scene: RunScene, device: Device, out: Path, status: StatusFile) -> Run:
    """Return a run of the pipeline on a scene, before its first stage."""
    settings = pipeline.settings
    budget = None if settings.scene.image_budget is None else settings.scene.image_budget << 20
    return Run(
        device=device,
        scene=scene.scene,
        original=scene.original,
        out=out,
        name=settings.name,
        seed=settings.seed,
        settings=settings,
        pipeline=pipeline.resolved(),
        rasterizer=Rasterizer(device, settings.rasterizer.sort, settings.rasterizer.budget()),
        harmonics=harmonics_of(settings),
        photographs=Photographs(device, scene.background, budget, undistorted_folder(out)),
        status=status,
        model_settings=settings.model,
        identity=scene.identity,
        read=contents(pipeline),
    )
