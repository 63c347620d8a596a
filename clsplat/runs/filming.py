"""Films of models: along a path, beside photographs or another model."""

import logging
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from clsplat.conformance.quick import open_correct
from clsplat.errors import ConfigError, DataError
from clsplat.opencl.device import Device
from clsplat.progress import counted
from clsplat.runs.found import has_pipeline
from clsplat.runs.loaded import Loaded, moves, painter_of, points_of, read
from clsplat.runs.pictures import KINDS, write_pictures
from clsplat.runs.source import Source, shown_of_run
from clsplat.scene.photographs import load_photograph
from clsplat.scene.scene import Background, Scene
from clsplat.scene.view import NO_FILE, View
from clsplat.training.field_file import is_field
from clsplat.video import camera_path
from clsplat.video.film import Film, Side, Wish, check_path_file, files, plan, shoot
from clsplat.video.paths import nearest
from clsplat.video.pictures import Canvas, Image, letterboxed
from clsplat.views.photographs import BACKGROUNDS

LOG = logging.getLogger("clsplat")
PHOTOGRAPH = "photograph"  # what can stand beside a picture; else a model


@dataclass(frozen=True)
class Place:
    """Where a film goes: into a video, or as pictures into a folder."""

    video: Path | None
    out: Path = Path("renders")
    kind: str = "png"


@dataclass(frozen=True)
class Extras:
    """What a film has beside its pictures."""

    side: str | None = None  # PHOTOGRAPH, or a model file or run folder
    layers: tuple[str, ...] = ("colour",)
    save_path: Path | None = None  # a camera_path.json to write


def film(
    model: Path,
    scene: Path | None,
    place: Place,
    wish: Wish,
    extras: Extras,
    *,
    downscale: float | None = None,
    device: str | Device | None = None,
) -> dict[str, Any]:
    """Film a model file or run folder; return `files`, `frames`, `fps`, `seconds`, `size`, and the time it `took`.

    Raises ClsplatError.
    """
    begun = time.perf_counter()
    videos = files(place.video, extras.layers) if place.video else {}
    if place.kind not in KINDS:
        raise ConfigError(f"no kind '{place.kind}'; there are {', '.join(KINDS)}")
    if videos and place.kind != KINDS[0]:
        raise ConfigError(f"--format {place.kind} is for pictures; a video has 8 bits: leave --video out")
    if extras.save_path:
        check_path_file(extras.save_path)
    if extras.side and not videos:
        raise ConfigError("--side needs --video: pictures of a folder stand alone")
    loaded = _read(model)
    found = _scene(model, scene, loaded, downscale, needed=not wish.of_a_file or extras.side == PHOTOGRAPH)
    made = plan(wish, found, points_of(loaded, found), moves=moves(loaded))
    if extras.save_path:
        camera_path.write(extras.save_path, made.views, made.fps)
    background = loaded.rendering.background or (found.background if found else "black")
    opened = open_correct(device)
    canvas = Canvas(painter_of(loaded, opened, background))
    if not videos:
        taken = [view.image_path for view in found.views] if found else []
        written = write_pictures(canvas, made.views, place.out, place.kind, extras.layers, taken, film=True)
    else:
        side = _side(extras.side, made, found, background, opened)
        shoot(canvas, made, videos, side, lambda views: counted(views, "frames rendered", len(views)))
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
    """What a model file or a run folder holds, wherever its photographs are."""
    file = shown_of_run(model) if has_pipeline(model) else model
    return read(file if is_field(file) else model)


def _scene(model: Path, scene: Path | None, loaded: Loaded, downscale: float | None, needed: bool) -> Scene | None:
    """The scene of a model at the size of its run; None where none is known and none is needed."""
    if not needed and scene is None and not has_pipeline(model):
        return None
    try:
        source = Source.of(model, scene)
    except DataError as error:
        if needed or scene is not None:
            raise
        LOG.warning("%s; without it: the background and the size are those of the model and the path", error)
        return None
    return source.scene(loaded).downscaled(source.settings.downscale if downscale is None else downscale)


def _side(name: str | None, made: Film, scene: Scene | None, background: Background, device: Device) -> Side | None:
    """What stands beside a picture: the photograph whose camera is nearest, or another model."""
    if name is None:
        return None
    if name != PHOTOGRAPH:
        other = _read(Path(name))
        return Canvas(painter_of(other, device, other.rendering.background or background)).picture
    assert scene is not None
    taken, reach = [view for view in scene.views if view.image_path != NO_FILE], scene.extent
    if not taken:
        raise ConfigError(f"--side {PHOTOGRAPH}: the scene {scene.path} has no photographs; name a model instead")

    @lru_cache(maxsize=4)
    def photograph(place: int) -> Image:
        return letterboxed(load_photograph(taken[place], BACKGROUNDS[background])[:, :, :3], made.size)

    def side(view: View) -> Image:
        return photograph(taken.index(nearest(view, taken, reach)))

    return side
