"""Render images and videos, and write cameras.  Errors and `device` are as in `clsplat.api.commands`."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import PathLike, layer_names, load_plugins, to_path
from clsplat.core.errors import ConfigError

if TYPE_CHECKING:  # the command line must start without importing OpenCL
    import numpy as np
    from numpy.typing import NDArray

    from clsplat.opencl.device import Device
    from clsplat.scene.scene import Scene
    from clsplat.scene.view import View

Size = str | tuple[int, int]  # 640x480, or width and height, px


def render_views(
    model: PathLike,
    scene: PathLike | None = None,
    out: PathLike = "renders",
    *,
    split: Literal["test", "train", "all"] = "test",
    downscale: float | None = None,
    format: Literal["png", "npy"] = "png",
    depth: bool | Literal["mean", "median"] = False,
    normals: bool = False,
    alpha: bool = False,
    time: float | None = None,
    device: "str | Device | None" = None,
) -> int:
    """Render a model at the views of a scene, and write one file per view.  Return the number of files.

    model: a model file, or a run folder; a model file without `scene` is rendered once, from outside, to view.png
    scene: a dataset folder; default: the dataset of the run
    downscale: divisor of the image size; default: the downscale factor of the run, or 1 for a model file
    format: "png" writes 8-bit images, "npy" float32 arrays, [height, width, 3]
    depth: True or "mean" also writes NAME_depth, the mean depth; "median" also writes NAME_median_depth, the depth at
        which the transmittance falls below ½, or 0 if it stays above; in scene units, as arrays [height, width]
    normals: also write NAME_normals, from the mean depth, in scene axes, as arrays [height, width, 3]; 0 where unknown
    alpha: also write NAME_alpha, in [0, 1], as arrays [height, width]
    time: render a dynamic model at this time, in [0, 1], instead of at the times of the views
    """
    from clsplat.runs import video as videos
    from clsplat.runs.model_file import FORMATS, SPLITS, ModelFile, is_model_alone
    from clsplat.viewer.video.plan import VideoRequest

    load_plugins()
    for option, value, choices in (("split", split, SPLITS), ("format", format, FORMATS)):
        if value not in choices:
            raise ConfigError(f"{option}: expected one of {', '.join(choices)}, got '{value}'")
    layers = layer_names(depth, normals, alpha)
    if scene is None and split == "test" and is_model_alone(Path(model)):
        target, request = videos.VideoTarget(None, Path(out), format), VideoRequest.parse("fixed", 1, None, None, time)
        extras = videos.VideoExtras(None, layers)
        made = videos.make_video(Path(model), None, target, request, extras, downscale=downscale, device=device)
        return len(made["files"])
    model_file = ModelFile(Path(model), to_path(scene), device, downscale)
    return model_file.render(split, Path(out), format, layers, time)


def render_path(
    model: PathLike,
    scene: PathLike | None = None,
    video: PathLike | None = "video.webm",
    *,
    out: PathLike = "renders",
    path: str = "ellipse",
    frames: int | None = None,
    fps: float | None = None,
    size: Size | None = None,
    times: "str | float | tuple[float, float] | None" = None,
    position: "Sequence[float] | None" = None,
    look_at: "Sequence[float] | None" = None,
    side: PathLike | None = None,
    depth: bool | Literal["mean", "median"] = False,
    normals: bool = False,
    alpha: bool = False,
    downscale: float | None = None,
    format: Literal["png", "npy"] = "png",
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Render a video of a model along a camera path, as `clsplat render --path` does.

    Returns a dictionary with `files`, the number of `frames`, `fps`, the duration in `seconds`, the `size` of a frame,
    and the rendering time `took`, in seconds.

    model, scene: as for `render_views`
    video: a .webm file, or a .mp4 file if the extra `video` is installed; None writes images of this `format` to `out`
    path: ellipse, spiral, orbit, through, views, fixed, fixed:NAME with the name of a view, or a camera_path.json file;
        for a model file without a scene, only orbit, ellipse, and fixed are available, and -y is up
    frames: 120 by default; a single image of a fixed camera is named view.png
    fps: 30 by default
    size: width and height, which must be even; default: the image size divided by `downscale`
    times: for a dynamic model, one time in [0, 1], or the times of the first and last frame, such as (0, 1) or "0..1";
        default: the full range, or the times of the views
    position, look_at: for the path `fixed`, the world coordinates, [3], of the camera and of the point to look at,
        by default the point nearest to the viewing axes of the cameras
    side: what the right half shows: "photograph" for the photo of the nearest camera, or the path of another model
    depth, normals, alpha: also write videos of these layers, as in `render_views`

    Raises ConfigError for a value out of range, a missing scene, or a file that must not be replaced.  Raises DataError
    for an unreadable file, or for a path that the cameras do not permit, and NumericError for images that are not
    finite.  Raises OutputError for a file that cannot be written, DeviceError for a device that does not work, and
    MemoryLimitError for a device with too little memory.
    """
    from clsplat.runs import video as videos
    from clsplat.viewer.video.plan import VideoRequest

    load_plugins()
    request, target = (
        VideoRequest.parse(str(path), frames, fps, size, times, position, look_at),
        videos.VideoTarget(to_path(video), Path(out), format),
    )
    extras = videos.VideoExtras(None if side is None else str(side), layer_names(depth, normals, alpha))
    return videos.make_video(Path(model), to_path(scene), target, request, extras, downscale=downscale, device=device)


def camera_path(
    scene: "Scene", path: str = "ellipse", frames: int | None = None, size: Size | None = None
) -> "list[View]":
    """Return the views of a camera path around or through a scene.

    path, frames, size: as for `render_path`

    Raises DataError if the cameras of the scene do not permit the path.
    """
    import numpy as np

    from clsplat.viewer.video.plan import VideoRequest, plan_video

    points = np.empty((0, 3), np.float32) if scene.points is None else scene.points.positions
    return plan_video(VideoRequest.parse(str(path), frames, None, size), scene, points).views


def write_video(file: PathLike, images: "Iterable[NDArray[np.generic]]", fps: float = 30) -> int:
    """Write images, [height, width, 3], float in [0, 1] or uint8, as a .webm or .mp4 video.  Return their number.

    Raises ConfigError for any other suffix, or an odd width or height, and ValueError for images of different sizes.
    """
    from clsplat.viewer.video.encoding import write_video

    return write_video(Path(file), images, fps)


def write_cameras(
    scene: "PathLike | Scene",
    out: PathLike,
    format: Literal["colmap", "nerfstudio", "inria"] = "colmap",
    images: Literal["none", "copy"] = "none",
) -> list[Path]:
    """Write the cameras of a dataset or a run for other programs, as `clsplat data cameras` does; return the files.

    format: sparse/0/*.bin of COLMAP, transforms.json of nerfstudio, or cameras.json of the original 3DGS code
    images: "copy" also copies the photos to out/images

    Raises DataError for a lens that the format does not support, and ConfigError if a file exists.
    """
    from clsplat.runs import model_file
    from clsplat.scene.scene import Scene

    load_plugins()
    return model_file.write_cameras(scene if isinstance(scene, Scene) else Path(scene), Path(out), format, images)
