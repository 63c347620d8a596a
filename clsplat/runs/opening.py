"""Open a run: check the device, prepare the photos, read the scene, and resolve settings that depend on the photos."""

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsplat.conformance.quick import open_verified
from clsplat.core.errors import ConfigError, DataError, first_few, pluralize
from clsplat.core.files import UNDISTORTED
from clsplat.core.machine import Owner
from clsplat.core.progress import Listener, listening, log_level
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import SCHEDULES
from clsplat.photos.photographs import Photographs
from clsplat.pipeline.file import RasterizerSettings, SceneSettings
from clsplat.pipeline.input_files import content_hashes
from clsplat.pipeline.loading import Pipeline, apply_adaptation, prepared_folder
from clsplat.pipeline.stretching import map_trainings
from clsplat.prepare.cache import PlannedStep, make_summary, prepare, read_statistics, read_summary
from clsplat.prepare.gather import list_photographs
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.estimate import estimate_time
from clsplat.runs.run_folder import Start
from clsplat.scene.camera import Camera
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import Identity, decode_all, require_content, require_decodable
from clsplat.scene.quality import Measures, measure_scene, near_depth, near_plane
from clsplat.scene.scene import SPLITS, Background, Scene, every_nth, make_scene
from clsplat.scene.view import View
from clsplat.scene.view_selection import MissingViewError
from clsplat.stages.optimize import Optimize
from clsplat.stages.train_field import TrainField
from clsplat.training.modules.sky_choice import choose_sky
from clsplat.training.run import Run
from clsplat.training.status import StatusFile, read_status

# The scene of a run, with all photos decoded.

LOG = logging.getLogger("clsplat")
MIN_VIEWS = 3  # training photos; with fewer, a warning is logged


@dataclass(frozen=True, eq=False)
class RunScene:
    """A scene with the settings of a run."""

    original: Scene  # with photos at full size
    scene: Scene  # with photos at the training size, or at several sizes
    background: Background
    identity: Identity

    @classmethod
    def from_scene(cls, settings: SceneSettings, scene: Scene) -> "RunScene":
        """Apply the settings to a scene, and decode its photos.

        Raises DataError, which names the files, if photos or masks cannot be used.
        """
        original, background = settings.apply(scene)
        downscaled_scene = original.downscaled(*settings.downscales)
        LOG.info(
            "scene: %s, %d training%s and %d test views, %s px, %s background, extent %.3g",
            *(
                scene.path,
                len(downscaled_scene.train),
                f", {len(downscaled_scene.validation)} validation" if downscaled_scene.validation else "",
                len(downscaled_scene.test),
                downscaled_scene.image_sizes,
                background,
                downscaled_scene.extent,
            ),
        )
        if len(original.train) < MIN_VIEWS:
            LOG.warning(
                "%s: only %s for training, so new views will look wrong; add photos",
                *(scene.path, pluralize(len(original.train), "photo")),
            )
        files = decode_all(
            view for version in (original, downscaled_scene) for split in SPLITS for view in version.split(split)
        )
        require_decodable(scene.path, files)
        if blank := require_content(scene.path, original.split("train"), files):
            count = pluralize(len(blank), "photo")
            LOG.warning(
                "%s: %s %s blank (black, a single color, or transparent): %s; export them again, or remove them",
                *(scene.path, count, "is" if len(blank) == 1 else "are", first_few(blank)),
            )
        return cls(original, downscaled_scene, background, Identity.from_scene(original, files))


ReadScene = Callable[[SceneSettings, Path], RunScene]


def read_run_scene(settings: SceneSettings, folder: Path) -> RunScene:
    """Read the scene in a folder with the settings of a run.  Raises DataError."""
    return RunScene.from_scene(settings, read_scene(folder, settings.split))


READ_SCENE = "read_scene"  # the last stage of the preparation


def open_run(
    pipeline: Pipeline,
    out: Path,
    device: str | Device | None,
    start: Start = "new",
    status: StatusFile | None = None,
    read: ReadScene = read_run_scene,
) -> Run:
    """Open the device, prepare and read the scene, and decode its photos; return the run before its first stage.

    start: with "restart", the photos may differ from those of the run in `out`.  status: receives the progress.
    Raises the errors of these steps.
    """
    opened_device, planned_steps = check_start(pipeline, out, device, start)
    if status:
        status.enter("preparing", device=opened_device.label)
    status = status or StatusFile(out)
    if any(step.reason for step in planned_steps):
        names = list_photo_names(pipeline, planned_steps, out)
        lines = estimate_time(pipeline, planned_steps, names, expect_measures(pipeline, names), opened_device, None)
        LOG.info("%s", "".join(lines[:1]))
    folder, root = pipeline.settings.scene.folder, prepared_folder(out)
    with listening(count_listener(status)):
        folder = prepare(planned_steps, folder, root, status.stage)
        with status.stage(READ_SCENE):
            run = make_run(pipeline, read(pipeline.settings.scene, folder), opened_device, out, status)
    run.prepared, run.preparation = (
        make_summary(planned_steps) if planned_steps else None,
        read_statistics(planned_steps),
    )
    return run


def count_listener(status: StatusFile) -> Listener:
    """Return a listener that writes the progress of the preparation to `status`.

    The remaining time is written only while the scene is read, since before that the time of later steps is unknown.
    """

    def note_count(unit: str, done: int, total: int, /, *, seconds_left: float | None) -> None:
        status.count(unit, done, total, seconds_left=seconds_left if status.now.stage == READ_SCENE else None)

    return note_count


def check_start(
    pipeline: Pipeline, out: Path, device: str | Device | None, start: Start
) -> tuple[Device, list[PlannedStep]]:
    """Check everything that can be checked before the photos are prepared; return the device and the `prepare` steps.

    Nothing is written.  Raises the errors that the run would raise.
    """
    settings = pipeline.settings
    for stage in pipeline.stages:
        stage.check()
    opened_device = _open_device(
        settings.rasterizer, device, read_status(out).get("device") if start == "resume" else ""
    )
    planned_steps = check_preparation(pipeline, out)
    if planned_steps and start != "restart" and read_summary(out) not in (None, make_summary(planned_steps)):
        raise ConfigError(f"{out}: was started with other photos or other settings of `prepare`; use another folder")
    return opened_device, planned_steps


def _open_device(rasterizer: RasterizerSettings, device: str | Device | None, earlier: object) -> Device:
    """Open a verified device; `auto` keeps the schedule of the earlier run if that used the same device.

    earlier: label of the device of the earlier run.
    """
    result = open_verified(device, rasterizer.schedule, rasterizer.sort)
    for schedule in SCHEDULES if rasterizer.schedule == "auto" and not isinstance(device, Device) else ():
        if earlier == f"{result.info.label}, {schedule} schedule" != result.label:
            return open_verified(device, schedule, rasterizer.sort)
    return result


def list_photo_names(pipeline: Pipeline, steps: Sequence[PlannedStep], out: Path) -> list[str]:
    """Return the names of the photos to prepare; empty if there are none, or if the pipeline does not prepare photos.

    Skipped files are logged.
    """
    try:
        return list_photographs(pipeline.settings.scene.folder, prepared_folder(out).parent.resolve()) if steps else []
    except DataError:
        return []


def check_preparation(pipeline: Pipeline, out: Path) -> list[PlannedStep]:
    """Check the steps that prepare the photos of a run in `out`, and return them; nothing is written.

    Raises ConfigError or DataError if the preparation is certain to fail.
    """
    planned_steps = pipeline.preparation(out)
    if planned_steps and planned_steps[0].reason:
        planned_steps[0].step.check(pipeline.settings.scene.folder.resolve(), prepared_folder(out).parent)
    if any(step.reason for step in planned_steps):
        _check_split(pipeline, planned_steps, out)
    return planned_steps


def _check_split(pipeline: Pipeline, planned_steps: Sequence[PlannedStep], out: Path) -> None:
    """Raise DataError if the split would reject the photos to prepare, even if all of them get a camera."""
    with log_level(logging.ERROR):
        names = list_photo_names(pipeline, planned_steps, out)
    if not names:
        return
    pipeline.settings.scene.split.check(pipeline.settings.scene.folder, names)
    with suppress(MissingViewError):  # a dry run reports it
        _placeholder_scene(pipeline, names)


def expect_measures(pipeline: Pipeline, names: Sequence[str]) -> Measures | None:
    """Return the measures that are known before the preparation, or None if there are no photos to prepare.

    Only the number of training and validation photos is known, and only if all of them get a camera.  Raises DataError
    if the split rejects the photos.
    """
    return Measures(len(_placeholder_scene(pipeline, names).merge_validation().train)) if names else None


def _placeholder_scene(pipeline: Pipeline, names: Sequence[str]) -> Scene:
    """Return a scene of the named photos with placeholder cameras, split as in the pipeline.  Raises DataError."""
    folder, split = pipeline.settings.scene.folder, pipeline.settings.scene.split
    pose = np.eye(3, 4, dtype=np.float32)
    views = [View(name, Camera(1, 1, 1.0, 1.0, 0.5, 0.5), pose, folder / name) for name in names]
    with log_level(logging.ERROR):
        return split.apply(make_scene(folder, views, every_nth(names, split.reader_holdout), None, "black"))


def undistorted_folder(out: Path) -> Path:
    """Return the folder of undistorted photos, in the run folder or in the target of a link next to the run folder.

    A sweep store creates the link so that its cells share the photos.  Each host uses a separate subfolder of the
    target, because the names of temporary files are unique only within a host.
    """
    link = out.absolute().parent / UNDISTORTED
    store_folder = Path(*link.parts[:-4]) / UNDISTORTED  # a link to another folder is not from the store
    is_store_link = link.is_symlink() and link.is_dir() and link.resolve().parent == store_folder.resolve()
    return link / Owner.current().host_slug if is_store_link else out / UNDISTORTED


def make_run(pipeline: Pipeline, run_scene: RunScene, device: Device, out: Path, status: StatusFile) -> Run:
    """Create the run of a pipeline on a scene, in the state before its first stage."""
    pipeline = with_lengths(pipeline, run_scene.scene)
    settings = pipeline.settings
    budget = None if settings.scene.image_budget is None else settings.scene.image_budget << 20
    return Run(
        device=device,
        scene=run_scene.scene,
        original=run_scene.original,
        out=out,
        name=settings.name,
        seed=settings.seed,
        settings=settings,
        pipeline=pipeline.resolved_settings(),
        rasterizer=Rasterizer(device, settings.rasterizer.sort, settings.rasterizer.limits()),
        harmonics=settings.harmonics,
        photographs=Photographs(device, run_scene.background, budget, undistorted_folder(out)),
        status=status,
        model_settings=settings.model,
        identity=run_scene.identity,
        file_hashes=content_hashes(pipeline),
    )


# Settings that depend on the photos, resolved before the first step and written to the run's pipeline.yaml.


def resolve_choices(pipeline: Pipeline, run: Run, log_reasons: bool = True) -> Pipeline:
    """Resolve `adapt` and `auto` settings from the photos; return the pipeline, and update the run with it.

    The choices of a resumed run do not change.  log_reasons: whether to log the reasons for the choices of `adapt`.
    """
    with run.status.stage("choose"):
        if pipeline.undecided:
            pipeline = apply_adaptation(pipeline, measure_scene(run.scene))
            for reason in pipeline.reasons if log_reasons else ():
                LOG.info("%s", reason)
        pipeline = _with_modules(with_lengths(pipeline, run.scene), run)
        run.settings, run.pipeline, run.model_settings = (
            pipeline.settings,
            pipeline.resolved_settings(),
            pipeline.settings.model,
        )
        run.harmonics = pipeline.settings.harmonics
        if any(isinstance(stage, Optimize) for stage in pipeline.stages):
            _warn_about_near_plane(pipeline.settings.model.near, near_depth(run.scene))
        return pipeline


def with_lengths(pipeline: Pipeline, scene: Scene) -> Pipeline:
    """Return the pipeline with its `auto` lengths (the near plane and the units of fields) resolved from the scene."""

    def with_unit(training: TrainField) -> TrainField:
        return training.model_copy(update={"field": training.field.with_unit(scene)})

    settings = map_trainings(pipeline.settings, TrainField, with_unit)
    if settings.model.near == "auto":
        model_settings = settings.model.model_copy(update=dict.fromkeys(("near", "near_auto"), near_plane(scene)))
        settings = settings.model_copy(update={"model": model_settings})
    return pipeline if settings == pipeline.settings else replace(pipeline, settings=settings)


def _warn_about_near_plane(near: float | str, nearest: float | None) -> None:
    """Warn if the nearest points are in front of the near plane.  Both distances are in scene units."""
    if isinstance(near, float) and nearest is not None and nearest < near:
        LOG.warning(
            "nothing nearer than model.near=%g scene units is rendered, but the nearest points of training photos are "
            "at %.3g; set model.near to %.2g",
            *(near, nearest, nearest / 2),
        )


def _with_modules(pipeline: Pipeline, run: Run) -> Pipeline:
    """Return the pipeline with the `auto` settings of its training modules resolved."""

    def with_resolved_modules(training: Optimize) -> Optimize:
        modules = [module.resolve_auto(run) for module in training.modules]
        return training if modules == training.modules else training.model_copy(update={"modules": modules})

    settings = map_trainings(pipeline.settings, Optimize, with_resolved_modules)
    modules = [module for stage in settings.stages if isinstance(stage, Optimize) for module in stage.modules]
    settings = settings.model_copy(update={"model": choose_sky(run, settings.model, modules)})
    return pipeline if settings == pipeline.settings else replace(pipeline, settings=settings)
