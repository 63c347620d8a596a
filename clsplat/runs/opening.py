"""Open what a run needs: the device, the photographs' preparation, the scene."""

import logging
from pathlib import Path

from clsplat.conformance.quick import open_correct
from clsplat.errors import ConfigError
from clsplat.names import UNDISTORTED
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import Pipeline, prepared_folder
from clsplat.prepare.cache import Planned, note, noted, prepare
from clsplat.progress import heard_by
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.folders import Start
from clsplat.scene.decoding import decode_all, require_whole
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import Identity
from clsplat.scene.scene import Scene
from clsplat.training.run import Run
from clsplat.training.status import StatusFile
from clsplat.views.photographs import Photographs

LOG = logging.getLogger("clsplat")


def open_run(
    pipeline: Pipeline, out: Path, device: str | Device | None, start: Start = "new", status: StatusFile | None = None
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
    with heard_by(status.count):
        folder = prepare(planned, folder, root, status.stage)
        with status.stage("read_scene"):
            scene = read_scene(folder, pipeline.settings.scene.holdout)
            run = make_run(pipeline, scene, opened, out, status)
    run.prepared = note(planned) if planned else None
    return run


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
    planned = pipeline.preparation(out)
    if planned and start != "restart" and noted(out) not in (None, note(planned)):
        raise ConfigError(
            f"{out}: was started with other photographs, or other settings of `prepare`; give another folder"
        )
    if planned and planned[0].why:
        planned[0].step.check(settings.scene.folder.resolve(), prepared_folder(out).parent)
    return opened, planned


def make_run(pipeline: Pipeline, scene: Scene, device: Device, out: Path, status: StatusFile) -> Run:
    """Return a run of the pipeline on a scene, before its first stage; every photograph was decoded.

    Raises DataError, naming the files, when some of the training or test photographs and masks cannot be used.
    """
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
    files = decode_all(
        view for one in (original, downscaled) for split in ("train", "test") for view in one.split(split)
    )
    require_whole(scene.path, files)
    return Run(
        device=device,
        scene=downscaled,
        original=original,
        out=out,
        name=settings.name,
        seed=settings.seed,
        settings=settings,
        pipeline=pipeline.resolved(),
        rasterizer=Rasterizer(device, settings.rasterizer.sort, settings.rasterizer.budget()),
        photographs=Photographs(device, background, None if budget is None else budget << 20, out / UNDISTORTED),
        status=status,
        model_settings=settings.model,
        identity=Identity.of(original, files),
    )
