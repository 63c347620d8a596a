"""Films of models: along a path, beside photographs or another model."""

import logging
import math
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.quick import open_verified
from clsplat.core.errors import ConfigError, DataError
from clsplat.core.files import PIPELINE, check_not_run_file
from clsplat.core.progress import counted
from clsplat.gaussians.model import Model, load
from clsplat.nerf.files import is_field
from clsplat.opencl.device import Device
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.runs.model_file import (
    KINDS,
    Loaded,
    ModelSource,
    moves,
    painter_of,
    points_of,
    read,
    require_model,
    run_of,
    shown_of_run,
    write_pictures,
)
from clsplat.runs.state import has_pipeline
from clsplat.scene.photographs import load_photograph
from clsplat.scene.scene import Background, Scene
from clsplat.scene.view import NO_FILE, View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.viewer.packing import pack
from clsplat.viewer.page import BUDGET, Page, Which, described, is_viewer
from clsplat.viewer.video.frames import Canvas, Image, letterbox
from clsplat.viewer.video.paths import Floats, nearest_view
from clsplat.viewer.video.plan import Side, VideoPlan, VideoRequest, layer_files, plan_video, render_video

LOG = logging.getLogger("clsplat")
PHOTOGRAPH = "photograph"  # what --side may show, besides a model


@dataclass(frozen=True)
class FilmTarget:
    """The output of a video: a file, or images in a folder."""

    video: Path | None
    out: Path = Path("renders")
    kind: str = "png"


@dataclass(frozen=True)
class Extras:
    """What a film has beside its pictures."""

    side: str | None = None  # PHOTOGRAPH, or a model file or run folder
    layers: tuple[str, ...] = ("color",)


def film(
    model: Path,
    scene: Path | None,
    place: FilmTarget,
    request: VideoRequest,
    extras: Extras,
    *,
    downscale: float | None = None,
    device: str | Device | None = None,
) -> dict[str, Any]:
    """Film a model file or run folder; return `files`, `frames`, `fps`, `seconds`, `size`, and the time it `took`.

    Raises ClsplatError.
    """
    begun = time.perf_counter()
    videos = layer_files(place.video, extras.layers) if place.video else {}
    if place.kind not in KINDS:
        raise ConfigError(f"no kind '{place.kind}'; there are {', '.join(KINDS)}")
    if videos and place.kind != KINDS[0]:
        raise ConfigError(f"--format {place.kind} is for pictures; a video has 8 bits: leave --video out")
    if extras.side and not videos:
        raise ConfigError("--side needs --video: pictures of a folder stand alone")
    loaded = _read(model)
    found = _scene(model, scene, loaded, downscale, needed=not request.is_file or extras.side == PHOTOGRAPH)
    origin = found.origin if found else loaded.origin
    loaded = loaded.with_origin(origin)
    made = plan_video(request, found, points_of(loaded, found), moves=moves(loaded), origin=origin)
    background = loaded.rendering.background or (found.background if found else "black")
    opened = open_verified(device)
    canvas = Canvas(painter_of(loaded, opened, background))
    if not videos:
        taken = [view.image_path for view in found.views] if found else []
        written = write_pictures(canvas, made.views, place.out, place.kind, extras.layers, taken, film=True)
    else:
        side = _side(extras.side, made, found, background, opened, origin)
        render_video(canvas, made, videos, side, lambda views: counted(views, "frames rendered", len(views)))
        written = list(videos.values())
    return {
        "files": [str(path) for path in written],
        "frames": len(made.views),
        "fps": made.fps,
        "seconds": made.seconds,
        "size": list(made.size),
        "took": time.perf_counter() - begun,
    }


def _read(model: Path) -> Loaded:
    """Read the model of a file or a run folder, which does not need its photos."""
    file = shown_of_run(model) if has_pipeline(model) else model
    return read(file if is_field(file) else model)


def _scene(model: Path, scene: Path | None, loaded: Loaded, downscale: float | None, needed: bool) -> Scene | None:
    """Return the scene of a model at the image size of its run; None if it is neither known nor needed."""
    if not needed and scene is None and not has_pipeline(model):
        return None
    try:
        source = ModelSource.of(model, scene)
    except DataError as error:
        if needed or scene is not None:
            raise
        LOG.warning("%s; without it: the background and the size are those of the model and the path", error)
        return None
    return source.scene(loaded).downscaled(source.settings.downscale if downscale is None else downscale)


def _side(
    name: str | None, made: VideoPlan, scene: Scene | None, background: Background, device: Device, origin: Floats
) -> Side | None:
    """Return what is shown next to a frame: the photo with the nearest camera, or another model."""
    if name is None:
        return None
    if name != PHOTOGRAPH:
        other = _read(Path(name)).with_origin(origin)
        return Canvas(painter_of(other, device, other.rendering.background or background)).picture
    assert scene is not None
    taken, reach = [view for view in scene.views if view.image_path != NO_FILE], scene.extent
    if not taken:
        raise ConfigError(f"--side {PHOTOGRAPH}: the scene {scene.path} has no photographs; name a model instead")

    @lru_cache(maxsize=4)
    def photograph(place: int) -> Image:
        return letterbox(load_photograph(taken[place], BACKGROUNDS[background])[:, :, :3], made.size)

    def side(view: View) -> Image:
        return photograph(taken.index(nearest_view(view, taken, reach)))

    return side


# One or two models on a page to walk through.

MAX_MODELS = 2  # side by side
MANY_SPLATS = 2_000_000  # a page with more is slow


def view(
    models: Sequence[Path],
    scene: Path | None = None,
    out: Path = Path("viewer.html"),
    *,
    photographs: Which = "test",
    photograph_budget: float = BUDGET,
    splats: int | None = None,
) -> Path:
    """Write a page that shows one model, or two side by side; return the page.  Raises ClsplatError.

    scene: its views and photos are in the page; default: the scene of the first run folder among the models.
    """
    if not 1 <= len(models) <= MAX_MODELS:
        raise ConfigError(f"view: expected one model or two, got {len(models)}")
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{out}: expected a name that ends in .html")
    if not (out.is_file() and is_viewer(out)):
        check_not_run_file(out)
    if splats is not None and splats < 1:
        raise ConfigError(f"--splats {splats}: expected a number of at least 1")
    if photographs not in ("none", "test", "all"):
        raise ConfigError(f"--photographs: expected none, test or all, got '{photographs}'")
    if not 0 <= photograph_budget < math.inf:
        raise ConfigError(f"--photograph-budget {photograph_budget:g}: expected MB, a finite number of at least 0")
    for path in models:
        require_model(path)
    source = next((ModelSource.of(path, scene) for path in models if scene is not None or run_of(path)), None)
    if photographs == "all" and source is None:
        raise ConfigError("--photographs all needs the photos of a scene; add --scene, or use a run folder")
    _tell_of_scenes(models, source)
    called = names(models)
    loaded = dict(zip(called, map(load, counted(models, "models read", len(models))), strict=True))
    _advise(loaded, splats)
    first = next(iter(loaded.values()))
    found = source.scene(first).downscaled(source.settings.downscale) if source else None
    background = first.rendering.background or (found.background if found else "black")
    origin = found.origin if found else first.origin
    loaded = {name: model.with_origin(origin) for name, model in loaded.items()}

    def read(one: View) -> NDArray[np.uint8]:
        return load_photograph(one, BACKGROUNDS[background])[:, :, :3]

    views = described(found, read, photographs, photograph_budget) if found else []
    start = (found.split("test") or found.views)[0] if found else None
    stand = Viewpoint.from_points(next(iter(loaded.values())).means, found.views if found else (), start)
    title = " and ".join(loaded) + (f" · {source.scene_name}" if source else "")
    if found is None:
        LOG.info("without a scene, up is -y; add --scene if the model is upside down")
    packed = counted(loaded.items(), "models packed", len(loaded))
    shown = {name: pack(model, splats) for name, model in packed}
    Page(title, shown, stand, background, views, origin).write(out)
    return out


def _advise(loaded: Mapping[str, Model], splats: int | None) -> None:
    """Warn about models with too many splats for a page, before packing them, which takes minutes."""
    for name, model in loaded.items():
        if min(len(model), splats or len(model)) > MANY_SPLATS:
            LOG.warning(
                "%s: %s splats take long to pack, and browsers show only %s smoothly; --splats %d keeps the most "
                "important",
                *(name, f"{len(model):,}", f"{MANY_SPLATS:,}", MANY_SPLATS),
            )


def _tell_of_scenes(models: Sequence[Path], source: ModelSource | None) -> None:
    """Warn if models are of different scenes, as the page has the cameras of one."""
    scenes = {}
    for name, run in zip(names(models), map(run_of, models), strict=True):
        with suppress(ConfigError):  # of a missing plug-in; the model can be shown without it
            if run and (path := load_pipeline(str(run / PIPELINE)).settings.scene.path):
                scenes[name] = Path(path).resolve()
    if source and len(set(scenes.values())) > 1:
        names_and_scenes = [part for item in scenes.items() for part in item]
        LOG.warning("%s is of %s, but %s of %s; the page has the cameras of %s", *names_and_scenes, source.scene_name)


def names(models: Sequence[Path]) -> list[str]:
    """Return a name for each model: that of its folder or file, with more of the path to tell two apart."""
    short = [path.resolve().name if path.is_dir() else path.stem for path in models]
    parents = [path.resolve().parent.name for path in models]
    if len(set(short)) < len(short):
        short = [f"{parent}/{name}" for parent, name in zip(parents, short, strict=True)]
    return short if len(set(short)) == len(short) else [f"{name} ({i})" for i, name in enumerate(short, 1)]
