"""Choose the views of a film, and draw them one after the other."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsplat.core.errors import ConfigError, quote
from clsplat.formats.splats import is_timestamp
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.view_selection import ViewSelection, choose
from clsplat.viewer.video import camera_path, encoding
from clsplat.viewer.video.frames import LAYERS, Canvas, Image, layer_image, side_by_side
from clsplat.viewer.video.paths import (
    PATHS,
    Floats,
    Rig,
    Size,
    check_fps,
    check_frames,
    check_size,
    even_size,
    like,
    stay,
)

# The moments of a film's frames, for scenes that move.

Times = tuple[float, float]  # of the first and of the last frame, in [0, 1] of the scene
WHOLE: Times = (0.0, 1.0)
EXPECTED = "expected a time from 0 to 1, or two such as 0..1"


def parse_times(given: "str | float | Sequence[float] | None") -> Times | None:
    """Return the moments of the first and the last frame from one number, two, or text such as 0..1; None stays.

    The second may come before the first: time runs backwards.  Raises ConfigError.
    """
    if given is None:
        return None
    parts = given.split("..") if isinstance(given, str) else [given] if isinstance(given, int | float) else list(given)
    try:
        found = [float(part) for part in parts]
    except (ValueError, TypeError):
        found = []
    if len(found) not in (1, 2) or not all(map(is_timestamp, found)):
        raise ConfigError(f"the time {quote(given)}: {EXPECTED}")
    return found[0], found[-1]


def with_times(views: Sequence[View], times: Times) -> list[View]:
    """Return views at evenly spaced moments from the first to the last; of one view, the first."""
    return [replace(view, time=float(time)) for view, time in zip(views, np.linspace(*times, len(views)), strict=True)]


def assign_times(views: Sequence[View], times: Times | None, moves: bool) -> list[View]:
    """Return the views of a film with their moments: those asked for, or their own, or the whole of a scene that moves.

    moves: whether the model does.  Raises ConfigError where moments are asked for of a model that does not.
    """
    if times is not None:
        require_motion(moves)
        return with_times(views, times)
    if moves and any(view.time is None for view in views):
        return with_times(views, WHOLE)
    return list(views)


def require_motion(moves: bool) -> None:
    """Raise ConfigError for moments of a model that does not move."""
    if not moves:
        raise ConfigError("a time was given, and the model does not move; leave the time out")


FROM = ":"  # between a path and the name of a view
FRAMES, FPS = 120, 30.0  # where neither the caller nor a file says
Through = Callable[[Sequence[View]], Iterable[View]]  # what views pass, such as a display of progress
Side = Callable[[View], Image]  # what stands beside a view's picture


@dataclass(frozen=True)
class VideoRequest:
    """What film was asked for, checked before any work: None is a default."""

    path: str = "ellipse"  # one of PATHS, fixed:NAME of a view, or a file of a camera path
    frames: int | None = None
    fps: float | None = None
    size: Size | None = None
    times: Times | None = None  # of a scene that moves

    @classmethod
    def parse(
        cls,
        path: str,
        frames: int | None,
        fps: float | None,
        size: str | Size | None,
        times: str | float | Sequence[float] | None = None,
    ) -> "VideoRequest":
        """Check what can be checked without a scene.  Raises ConfigError."""
        if path.partition(FROM)[0] not in PATHS and not path.lower().endswith(".json"):
            raise ConfigError(f"no path {quote(path)}; there are {', '.join(PATHS)}, and files of nerfstudio (.json)")
        if FROM in path and path.partition(FROM)[0] in PATHS and not path.startswith(f"fixed{FROM}"):
            raise ConfigError(f"no path {quote(path)}; only `fixed{FROM}NAME` names a view")
        return cls(
            path,
            None if frames is None else check_frames(frames),
            None if fps is None else check_fps(fps),
            None if size is None else check_size(size),
            parse_times(times),
        )

    @property
    def is_file(self) -> bool:
        """Whether the path is in a file, and needs no scene."""
        return self.path.partition(FROM)[0] not in PATHS


@dataclass(frozen=True)
class VideoPlan:
    """The views of a film, one a frame, all of one size."""

    views: list[View]
    fps: float

    @property
    def size(self) -> Size:
        """Width and height of a picture, px."""
        camera = self.views[0].camera
        return camera.width, camera.height

    @property
    def seconds(self) -> float:
        """How long it lasts."""
        return len(self.views) / self.fps


def plan_video(
    request: VideoRequest, scene: Scene | None, points: Floats, moves: bool = False, origin: Floats | None = None
) -> VideoPlan:
    """Return the film of a scene.  points: [M, 3], means of a model, or points of the scene; moves: whether it does.

    origin: [3] world coordinates of the points' zero, by default that of the scene.

    Raises ConfigError without a scene where the path needs one, and for times where nothing moves; DataError where the
    scene has no such path.
    """
    found = _path(request, scene, points, scene.origin if scene and origin is None else origin)
    return replace(found, views=assign_times(found.views, request.times, moves))


def _path(request: VideoRequest, scene: Scene | None, points: Floats, origin: Floats | None) -> VideoPlan:
    """The film without regard to time."""
    if request.is_file:
        found = camera_path.read(Path(request.path), scene.path if scene else None)
        views = found.resized(request.size) if request.size else found.views
        views = views if origin is None else [view.shifted(origin) for view in views]  # files have world coordinates
        return VideoPlan(camera_path.resample(views, request.frames or len(views)), request.fps or found.fps)
    if scene is None:
        raise ConfigError(
            f"the path {request.path} needs the cameras of a scene; give --scene, a run folder, or a file"
        )
    rig = Rig.from_views(scene.views, points)
    size = request.size or even_size(rig.camera)
    if FROM in request.path:
        names = [view.name for view in scene.views]
        (chosen,) = choose(ViewSelection(names=[request.path.partition(FROM)[2]]), names, [])
        return VideoPlan(stay(scene.views[chosen], request.frames or FRAMES, size), request.fps or FPS)
    return VideoPlan(PATHS[request.path](rig, request.frames or FRAMES, size), request.fps or FPS)


def layer_files(video: Path, layers: Sequence[str]) -> dict[str, Path]:
    """Return the file of each layer: that of the colors, and others beside it.  Raises ConfigError for their names."""
    found = {
        layer: video if layer == LAYERS[0] else video.with_name(f"{video.stem}_{layer}{video.suffix}")
        for layer in layers
    }
    for path in found.values():
        encoding.check_file(path)
    return found


def render_video(
    canvas: Canvas, film: VideoPlan, videos: Mapping[str, Path], side: Side | None, through: Through
) -> None:
    """Render the views into videos, one a layer.  side: what stands on the right of the colors."""
    wide = film.size[0] * (1 if side is None else 2)
    check_size((wide, film.size[1]))
    depths = canvas.depth_range(film.views) if "depth" in videos else (0.0, 0.0)
    with ExitStack() as stack:
        writers = {
            layer: stack.enter_context(
                encoding.open_video(path, (wide if layer == LAYERS[0] else film.size[0], film.size[1]), film.fps)
            )
            for layer, path in videos.items()
        }
        for view in through(film.views):
            found = canvas.layers(view, "depth" in videos)
            for layer, write in writers.items():
                picture = layer_image(found, layer, depths)
                write(side_by_side(picture, side(view)) if side and layer == LAYERS[0] else picture)


def resize_view(view: View, size: Size | None = None) -> View:
    """Return a view for a film from one place: at another size, or with even sides."""
    wanted = size or even_size(view.camera)
    if wanted == (view.camera.width, view.camera.height):
        return view
    return View(view.name, like(view.camera, wanted), view.world_to_camera, view.image_path, time=view.time)
