"""Choose the views of a video, and render them one after another."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from clsplat.core.errors import ConfigError, quote
from clsplat.formats.splats import is_timestamp
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.view_selection import ViewSelection
from clsplat.scene.viewpoint import circle_views
from clsplat.viewer.video import camera_path, encoding
from clsplat.viewer.video.frames import DEPTH_LAYERS, LAYERS, Canvas, Image, layer_image, side_by_side
from clsplat.viewer.video.paths import (
    PATHS,
    Floats,
    Rig,
    Size,
    check_fps,
    check_frames,
    check_size,
    even_size,
    look_at_targets,
    repeat_view,
    same_area,
)

# Timestamps of the frames, for moving scenes.

Times = tuple[float, float]  # timestamps of the first and the last frame, in [0, 1]
FULL_RANGE: Times = (0.0, 1.0)


def parse_times(value: "str | float | Sequence[float] | None") -> Times | None:
    """Parse the timestamps of the first and the last frame, given as one or two numbers or as text such as 0..1.

    None is returned unchanged.  If the second timestamp is smaller, time runs backward.  Raises ConfigError.
    """
    if value is None:
        return None
    parts = value.split("..") if isinstance(value, str) else [value] if isinstance(value, int | float) else list(value)
    try:
        times = [float(part) for part in parts]
    except (ValueError, TypeError):
        times = []
    if len(times) not in (1, 2) or not all(map(is_timestamp, times)):
        raise ConfigError(f"time {quote(value)}: expected a time from 0 to 1, or a range such as 0..1")
    return times[0], times[-1]


def with_times(views: Sequence[View], times: Times) -> list[View]:
    """Return views with evenly spaced timestamps from the first to the last time.

    A single view gets the first time.
    """
    return [replace(view, time=float(time)) for view, time in zip(views, np.linspace(*times, len(views)), strict=True)]


def assign_times(views: Sequence[View], times: Times | None, is_moving: bool) -> list[View]:
    """Return views with the requested timestamps.

    If none are requested, existing timestamps are kept, unless the model moves and a view has no timestamp; then the
    timestamps of all views span the full range.
    is_moving: whether the model moves.  Raises ConfigError if timestamps were requested for a model that does not move.
    """
    if times is not None:
        require_motion(is_moving)
        return with_times(views, times)
    if is_moving and any(view.time is None for view in views):
        return with_times(views, FULL_RANGE)
    return list(views)


def require_motion(is_moving: bool) -> None:
    """Raise ConfigError unless the model moves."""
    if not is_moving:
        raise ConfigError("a time was given, but the model does not move; omit the time")


SEPARATOR = ":"  # between a path and the name of a view
FRAMES, FPS = 120, 30.0  # defaults
Progress = Callable[[Sequence[View]], Iterable[View]]  # yields the views, and may show progress
Side = Callable[[View], Image]  # the image to the right of a view's render


WITHOUT_SCENE = ("ellipse", "orbit", "fixed")  # paths that are possible for a model alone
Position = tuple[float, float, float]


def _check_position(option: str, position: Sequence[float] | None) -> Position | None:
    """Return a position as a tuple; None stays None.  Raises ConfigError unless it is 3 finite numbers."""
    if position is None:
        return None
    if len(position) != 3 or not all(map(math.isfinite, position)):
        raise ConfigError(
            f"{option} {quote(tuple(position))}: expected x, y, and z in world coordinates, as in 0,-1,2.5"
        )
    return position[0], position[1], position[2]


@dataclass(frozen=True)
class VideoRequest:
    """The settings of a video, checked in advance; None means the default."""

    path: str = "ellipse"  # one of PATHS, fixed:NAME of a view, or a file of a camera path
    frames: int | None = None
    fps: float | None = None
    size: Size | None = None
    times: Times | None = None  # for a moving scene
    position: Position | None = None  # of the camera of the path `fixed`, in world coordinates
    target: Position | None = None  # the point that it looks at; default: the focus of the scene

    @classmethod
    def parse(
        cls,
        path: str,
        frames: int | None,
        fps: float | None,
        size: str | Size | None,
        times: str | float | Sequence[float] | None = None,
        position: Sequence[float] | None = None,
        target: Sequence[float] | None = None,
    ) -> "VideoRequest":
        """Parse the settings, and check everything that does not depend on the scene.  Raises ConfigError."""
        if path.partition(SEPARATOR)[0] not in PATHS and not path.lower().endswith(".json"):
            raise ConfigError(
                f"path {quote(path)}: expected one of {', '.join(PATHS)}, or a .json file with a camera path"
            )
        if SEPARATOR in path and path.partition(SEPARATOR)[0] in PATHS and not path.startswith(f"fixed{SEPARATOR}"):
            raise ConfigError(f"path {quote(path)}: only `fixed{SEPARATOR}NAME` accepts the name of a view")
        if position is None and target is not None:
            raise ConfigError("a point to look at was given without the position of the camera; add --from X,Y,Z")
        if position is not None and path != "fixed":
            raise ConfigError(f"path {quote(path)}: a camera with a given position does not follow a path; omit --path")
        if position is not None and target is not None and tuple(position) == tuple(target):
            raise ConfigError(f"--look-at {quote(tuple(target))}: is the position of the camera; use another point")
        return cls(
            path,
            None if frames is None else check_frames(frames),
            None if fps is None else check_fps(fps),
            None if size is None else check_size(size),
            parse_times(times),
            _check_position("--from", position),
            _check_position("--look-at", target),
        )

    @property
    def needs_scene(self) -> bool:
        """Whether the path follows the cameras of a scene, so that it is impossible for a model alone."""
        return not self.is_file and self.path not in WITHOUT_SCENE

    @property
    def is_file(self) -> bool:
        """Whether the camera path is a file, which can be read without a scene."""
        return self.path.partition(SEPARATOR)[0] not in PATHS


@dataclass(frozen=True)
class VideoPlan:
    """The views of a video, one per frame, all of the same size."""

    views: list[View]
    fps: float

    @property
    def size(self) -> Size:
        """Width and height of a frame, px."""
        camera = self.views[0].camera
        return camera.width, camera.height

    @property
    def seconds(self) -> float:
        """The duration of the video, s."""
        return len(self.views) / self.fps


def plan_video(
    request: VideoRequest, scene: Scene | None, points: Floats, is_moving: bool = False, origin: Floats | None = None
) -> VideoPlan:
    """Plan the video of a scene.  points: [M, 3], the means of a model or the points of the scene.

    is_moving: whether the model moves; origin: world coordinates of the origin of `points`, [3]; default: the scene's.
    Without a scene, the paths ellipse, orbit, and fixed circle around the points, with up at -y.
    Raises ConfigError if the path needs a scene and there is none, or if times are set for a model that does not move,
    and DataError if the path is impossible in the scene.
    """
    plan = _plan_path(request, scene, points, scene.origin if scene and origin is None else origin)
    return replace(plan, views=assign_times(plan.views, request.times, is_moving))


def _plan_path(request: VideoRequest, scene: Scene | None, points: Floats, origin: Floats | None) -> VideoPlan:
    """Plan a video without timestamps."""
    if request.is_file:
        camera_file = camera_path.read(Path(request.path), scene.path if scene else None)
        views = camera_file.resized(request.size) if request.size else camera_file.views
        views = views if origin is None else [view.shifted(origin) for view in views]  # files have world coordinates
        return VideoPlan(camera_path.resample(views, request.frames or len(views)), request.fps or camera_file.fps)
    if scene is None and request.needs_scene:
        raise ConfigError(
            f"the path {request.path} needs the cameras of a scene; pass --scene, a run folder, or a path file"
        )
    rig = Rig.from_views(scene.views if scene else circle_views(points), points)
    size = request.size or even_size(rig.camera)
    if request.position is not None:
        offset = np.zeros(3) if origin is None else origin
        target = rig.focus if request.target is None else request.target - offset
        forward, up = target - (request.position - offset), rig.up
        if np.linalg.norm(np.cross(forward, up)) <= 1e-9 * np.linalg.norm(forward):  # straight down or up
            up = np.eye(3)[2 - np.abs(up[::-1]).argmin()]
        views = look_at_targets(request.position - offset[None], target[None], up[None], rig, size)
        return VideoPlan(repeat_view(views[0], request.frames or FRAMES, size), request.fps or FPS)
    if scene is None and request.path == "fixed":
        return VideoPlan(repeat_view(rig.views[0], request.frames or FRAMES, size), request.fps or FPS)
    if scene and SEPARATOR in request.path:
        names = [view.name for view in scene.views]
        (index,) = ViewSelection(names=[request.path.partition(SEPARATOR)[2]]).select(names, [])
        return VideoPlan(repeat_view(scene.views[index], request.frames or FRAMES, size), request.fps or FPS)
    return VideoPlan(PATHS[request.path](rig, request.frames or FRAMES, size), request.fps or FPS)


def layer_files(video: Path, layers: Sequence[str]) -> dict[str, Path]:
    """Return the video file of each layer; `video` is the file of `color`.  Raises ConfigError for invalid names."""
    files = {
        layer: video if layer == LAYERS[0] else video.with_name(f"{video.stem}_{layer}{video.suffix}")
        for layer in layers
    }
    for path in files.values():
        encoding.check_file(path)
    return files


def render_video(
    canvas: Canvas, plan: VideoPlan, videos: Mapping[str, Path], side: Side | None, progress: Progress
) -> None:
    """Render the views to videos, one per layer.

    side: returns the image that the color video shows to the right of a view.
    """
    full_width = plan.size[0] * (1 if side is None else 2)
    check_size((full_width, plan.size[1]))
    depths = (0.0, 0.0) if DEPTH_LAYERS.isdisjoint(videos) else canvas.depth_range(plan.views)
    with ExitStack() as stack:
        writers = {
            layer: stack.enter_context(
                encoding.open_video(path, (full_width if layer == LAYERS[0] else plan.size[0], plan.size[1]), plan.fps)
            )
            for layer, path in videos.items()
        }
        for view in progress(plan.views):
            layers = canvas.render_layers(view, videos)
            for layer, write in writers.items():
                image = layer_image(layers, layer, depths)
                write(side_by_side(image, side(view)) if side and layer == LAYERS[0] else image)


def resize_view(view: View, size: Size | None = None) -> View:
    """Return a view at another image size.  By default, its size is rounded down to even sides."""
    target = size or even_size(view.camera)
    if target == (view.camera.width, view.camera.height):
        return view
    return View(view.name, same_area(view.camera, target), view.world_to_camera, view.image_path, time=view.time)
