"""Render videos of models along a path, and write viewer pages."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.quick import open_verified
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.files import PIPELINE, check_not_run_file, scratch_folder
from clsplat.core.progress import counted
from clsplat.formats.splats import Quality
from clsplat.gaussians.conversion import Changes, convert
from clsplat.gaussians.model import Model, load
from clsplat.nerf.files import is_field
from clsplat.opencl.device import Device
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.runs.model_file import (
    FORMATS,
    AnyModel,
    ModelSource,
    content_points,
    find_run,
    is_moving,
    make_painter,
    read,
    require_model,
    trained_file,
    write_renders,
)
from clsplat.runs.state import has_pipeline
from clsplat.scene.photographs import load_photograph
from clsplat.scene.scene import Background, Scene
from clsplat.scene.view import NO_FILE, View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import pack
from clsplat.viewer.page import BUDGET, IncludedPhotos, Page, is_viewer, view_entries
from clsplat.viewer.video.frames import Canvas, Image, letterbox
from clsplat.viewer.video.paths import Floats, nearest_view
from clsplat.viewer.video.plan import Side, VideoPlan, VideoRequest, layer_files, plan_video, render_video

LOG = logging.getLogger("clsplat")
STILL = "view"  # name of the only image of a fixed camera
PHOTOGRAPH = "photograph"  # value of --side; any other value is a model


@dataclass(frozen=True)
class VideoTarget:
    """The output of a video: a file, or images in a folder."""

    video: Path | None  # the video file; None: write images
    out: Path = Path("renders")  # folder of the images
    file_format: str = "png"  # file format of the images, one of FORMATS


@dataclass(frozen=True)
class VideoExtras:
    """Additional content of a video: an image next to each frame, and layers other than color."""

    side: str | None = None  # PHOTOGRAPH, or a model file or run folder
    layers: tuple[str, ...] = ("color",)


def make_video(
    model: Path,
    scene: Path | None,
    target: VideoTarget,
    request: VideoRequest,
    extras: VideoExtras,
    *,
    downscale: float | None = None,
    device: str | Device | None = None,
) -> dict[str, Any]:
    """Render a video of a model file or run folder along a path.

    Returns a dictionary with `files`, `frames` (their number), `fps`, `seconds` (duration of the video), `size` (width
    and height, px), and `took` (rendering time, s).  Raises ClsplatError.
    """
    start_time = time.perf_counter()
    videos = layer_files(target.video, extras.layers) if target.video else {}
    if target.file_format not in FORMATS:
        raise ConfigError(f"--format: expected {' or '.join(FORMATS)}, got '{target.file_format}'")
    if videos and target.file_format != FORMATS[0]:
        raise ConfigError(
            f"--format {target.file_format} applies only to images, since videos have 8 bits per channel; omit --video"
        )
    if extras.side and not videos:
        raise ConfigError("--side needs --video, because images are written without a comparison; add --video FILE")
    content = _read(model)
    is_alone = scene is None and find_run(model) is None and isinstance(content, Model)
    needs_scene = request.needs_scene or not (request.is_file or is_alone)
    used_scene = _read_scene(model, scene, content, downscale, is_required=needs_scene or extras.side == PHOTOGRAPH)
    if used_scene is None and downscale is not None:
        raise ConfigError(f"{model}: --scale is for the images of a scene; use --path and --size WxH, or add --scene")
    origin = used_scene.origin if used_scene else content.origin
    content = content.in_scene(used_scene) if used_scene else content
    plan = plan_video(request, used_scene, content_points(content, used_scene), is_moving(content), origin)
    background = content.rendering.background or (used_scene.background if used_scene else "black")
    opened_device = open_verified(device)
    canvas = Canvas(make_painter(content, opened_device, background))
    if not videos:
        photo_files = [view.image_path for view in used_scene.views] if used_scene else []
        is_still = request.frames == 1 and request.path == "fixed"
        views = [replace(plan.views[0], name=STILL)] if is_still else plan.views
        files = write_renders(
            canvas, views, target.out, target.file_format, extras.layers, photo_files, is_video=not is_still
        )
    else:
        side = _side_image_function(extras.side, plan, used_scene, background, opened_device, origin)
        render_video(canvas, plan, videos, side, lambda views: counted(views, "frames rendered", len(views)))
        files = list(videos.values())
    return {
        "files": [str(path) for path in files],
        "frames": len(plan.views),
        "fps": plan.fps,
        "seconds": plan.seconds,
        "size": list(plan.size),
        "took": time.perf_counter() - start_time,
    }


def _read(model: Path) -> AnyModel:
    """Read the model from a file or a run folder.  No photos are read."""
    file = trained_file(model) if has_pipeline(model) else model
    return read(file if is_field(file) else model)


def _read_scene(
    model: Path, scene: Path | None, host_model: AnyModel, downscale: float | None, is_required: bool
) -> Scene | None:
    """Return the scene of a model, or None if the scene is unknown and not required.

    downscale: the divisor of the original image size; None: as in the run.
    """
    if not is_required and scene is None and not has_pipeline(model):
        return None
    try:
        source = ModelSource.from_model(model, scene)
    except DataError as error:
        if is_required or scene is not None:
            raise
        LOG.warning(
            "%s; continuing without a scene, using the model's background and the image size in the path file", error
        )
        return None
    return source.scene(host_model).downscaled(source.settings.downscale if downscale is None else downscale)


def _side_image_function(
    name: str | None, plan: VideoPlan, scene: Scene | None, background: Background, device: Device, origin: Floats
) -> Side | None:
    """Return a function that returns the image next to a view's frame: the nearest photo, or another model's render."""
    if name is None:
        return None
    if name != PHOTOGRAPH:
        model = _read(Path(name))
        model = model.in_scene(scene) if scene else model.with_origin(origin)
        return Canvas(make_painter(model, device, model.rendering.background or background)).render_image
    assert scene is not None
    photo_views, extent = [view for view in scene.views if view.image_path != NO_FILE], scene.extent
    if not photo_views:
        raise ConfigError(f"--side {PHOTOGRAPH}: the scene {scene.path} has no photos; use a model instead")

    @lru_cache(maxsize=4)
    def photograph(index: int) -> Image:
        return letterbox(load_photograph(photo_views[index], BACKGROUNDS[background])[:, :, :3], plan.size)

    def side(view: View) -> Image:
        return photograph(photo_views.index(nearest_view(view, photo_views, extent)))

    return side


# A viewer page with one or two models.

MAX_MODELS = 2  # side by side
PAGE_ENDINGS = (".html", ".htm")
MANY_SPLATS = 2_000_000  # pages with more splats are slow


def view(
    models: Sequence[Path],
    scene: Path | None = None,
    out: Path = Path("viewer.html"),
    *,
    photographs: IncludedPhotos = "test",
    photograph_budget: float = BUDGET,
    splats: int | None = None,
) -> Path:
    """Write a viewer page that shows one or two models, side by side; return the page's path.  Raises ClsplatError.

    scene: dataset or run folder whose views and photos the page includes; default: the scene of the first model that is
    from a run.
    """
    if not 1 <= len(models) <= MAX_MODELS:
        raise ConfigError(f"view: expected one model or two, got {len(models)}")
    if out.suffix.lower() not in PAGE_ENDINGS:
        raise ConfigError(f"{out}: expected a name that ends in .html")
    if not (out.is_file() and is_viewer(out)):
        check_not_run_file(out)
    if splats is not None and splats < 1:
        raise ConfigError(f"--splats {splats}: expected a number of at least 1")
    if photographs not in ("none", "test", "all"):
        raise ConfigError(f"--photographs: expected none, test, or all, got '{photographs}'")
    if not 0 <= photograph_budget < math.inf:
        raise ConfigError(f"--photograph-budget {photograph_budget:g}: expected a finite number of MB, 0 or more")
    for path in models:
        require_model(path)
    source = next((ModelSource.from_model(path, scene) for path in models if scene is not None or find_run(path)), None)
    if photographs == "all" and source is None:
        raise ConfigError("--photographs all needs the photos of a scene; add --scene, or use a run folder")
    _warn_about_different_scenes(models, source)
    by_name = dict(zip(model_names(models), map(load, counted(models, "models read", len(models))), strict=True))
    _warn_about_size(by_name, splats)
    first_model = next(iter(by_name.values()))
    used_scene = source.scene(first_model).downscaled(source.settings.downscale) if source else None
    background = first_model.rendering.background or (used_scene.background if used_scene else "black")
    origin = used_scene.origin if used_scene else first_model.origin
    by_name = {
        name: model.in_scene(used_scene) if used_scene else model.with_origin(origin) for name, model in by_name.items()
    }

    def read_photo(view: View) -> NDArray[np.uint8]:
        return load_photograph(view, BACKGROUNDS[background])[:, :, :3]

    views = view_entries(used_scene, read_photo, photographs, photograph_budget) if used_scene else []
    start = (used_scene.split("test") or used_scene.views)[0] if used_scene else None
    viewpoint = Viewpoint.from_points(
        next(iter(by_name.values())).scene_means, used_scene.views if used_scene else (), start
    )
    title = " and ".join(by_name) + (f" · {source.scene_name}" if source else "")
    if used_scene is None:
        LOG.info("without a scene, up is -y; add --scene if the model is upside down")
    named_models = counted(by_name.items(), "models packed", len(by_name))
    packed_models = {name: pack(model, splats) for name, model in named_models}
    Page(title, packed_models, viewpoint, background, views, origin).write(out)
    return out


def convert_to_page(sources: Sequence[Path], out: Path, changes: Changes, quality: Quality) -> dict[str, Any]:
    """Convert models as `conversion.convert` does, but write a viewer page without a scene.  Raises ClsplatError."""
    if quality != "balanced" or changes.collider:
        raise ConfigError(f"{out}: pages have no --quality and no --collider; omit them")
    with scratch_folder(out) as folder:
        file = folder / f"{out.stem}.ply"
        result = convert(sources, file, changes)
        page = view([file], None, out, photographs="none")
    return {**result, "file": str(out), "format": "HTML", "bytes": page.stat().st_size}


def _warn_about_size(models_by_name: Mapping[str, Model], max_splats: int | None) -> None:
    """Warn about models with too many splats for a page.  Call this before packing them, which takes minutes."""
    for name, model in models_by_name.items():
        if min(len(model), max_splats or len(model)) > MANY_SPLATS:
            LOG.warning(
                "%s: %s splats take a long time to pack, and browsers show only %s smoothly; --splats %d keeps the "
                "most important ones",
                *(name, f"{len(model):,}", f"{MANY_SPLATS:,}", MANY_SPLATS),
            )


def _warn_about_different_scenes(models: Sequence[Path], source: ModelSource | None) -> None:
    """Warn if the models are of different scenes, because the page has the cameras of only one scene."""
    scenes = {}
    for name, run in zip(model_names(models), map(find_run, models), strict=True):
        with suppress(ConfigError):  # of a missing plug-in; the model can be shown without it
            if run and (path := load_pipeline(str(run / PIPELINE)).settings.scene.path):
                scenes[name] = Path(path).resolve()
    if source and len(set(scenes.values())) > 1:
        names_and_scenes = [text for item in scenes.items() for text in item]
        LOG.warning("%s shows %s, %s shows %s; the page has the cameras of %s", *names_and_scenes, source.scene_name)


def model_names(models: Sequence[Path]) -> list[str]:
    """Return a unique name for each model: its folder or file name, with the parent folder if names repeat."""
    names = [path.resolve().name if path.is_dir() else path.stem for path in models]
    folders = [path.resolve().parent.name for path in models]
    if len(set(names)) < len(names):
        names = [f"{parent}/{name}" for parent, name in zip(folders, names, strict=True)]
    return names if len(set(names)) == len(names) else [f"{name} ({i})" for i, name in enumerate(names, 1)]
