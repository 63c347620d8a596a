"""Pictures, films and cameras as functions; errors and `device` as in `clsplat.api.commands`."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from clsplat.api.arguments import PathLike, layer_names, load_plugins, path_of

if TYPE_CHECKING:  # the command line starts without OpenCL
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
    kind: Literal["png", "npy"] = "png",
    depth: bool = False,
    alpha: bool = False,
    time: float | None = None,
    device: "str | Device | None" = None,
) -> int:
    """Render a model at the views of a scene, one file for each view; return the number of files.

    model: a file, with `scene`, or a run folder, whose scene is the default; downscale: divisor of the photographs'
    size, by default that of the run, 1 for a file; kind: 8-bit images, or float32 arrays [height, width, 3]; depth,
    alpha: files NAME_depth and NAME_alpha beside, as arrays [height, width] in scene units and in [0, 1]; time: of a
    model that moves, in [0, 1], instead of the views' own.
    """
    from clsplat.runs import model_file

    load_plugins()
    return model_file.render(
        Path(model),
        path_of(scene),
        Path(out),
        split=split,
        downscale=downscale,
        kind=kind,
        layers=layer_names(depth, alpha),
        time=time,
        device=device,
    )


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
    side: PathLike | None = None,
    depth: bool = False,
    alpha: bool = False,
    downscale: float | None = None,
    kind: Literal["png", "npy"] = "png",
    device: "str | Device | None" = None,
) -> dict[str, Any]:
    """Film a model along a camera path, as `clsplat render --path` does.

    Return a table: `files`, the number of `frames`, `fps`, the `seconds` that the film lasts, the `size` of a picture
    and how long it `took`, s.

    model, scene: a file and its scene, or a run folder; video: a file that ends in .webm, or .mp4 with the extra
    `video`; None: pictures of this `kind` into the folder `out`; path: ellipse, spiral, orbit, through, views,
    fixed, fixed:NAME of a view, or a file camera_path.json; frames: by default 120; fps: by default 30; size: even
    numbers, by default that of the photographs by `downscale`; times: of a model that moves, one moment in [0, 1],
    or those of the first and the last frame, such as (0, 1) or "0..1", by default the whole or the views' own;
    side: "photograph", of the nearest camera, or another model, on the right; depth, alpha: files of these beside.

    Raises ConfigError for values out of bounds, without a scene that the path needs, and where other files would be
    replaced; DataError for files that cannot be read, and where the scene's cameras give no such path; NumericError for
    pictures that are not finite; OutputError where files cannot be written; the errors of the device.
    """
    from clsplat.runs import film
    from clsplat.viewer.video.film import Wish

    load_plugins()
    wish, place = Wish.of(str(path), frames, fps, size, times), film.FilmTarget(path_of(video), Path(out), kind)
    extras = film.Extras(None if side is None else str(side), layer_names(depth, alpha))
    return film.film(Path(model), path_of(scene), place, wish, extras, downscale=downscale, device=device)


def camera_path(
    scene: "Scene", path: str = "ellipse", frames: int | None = None, size: Size | None = None
) -> "list[View]":
    """Return the views of a camera path about or through a scene, to be rendered one by one.

    path: as for `render_path`.  Raises DataError where the scene's cameras give no such path.
    """
    import numpy as np

    from clsplat.viewer.video.film import Wish, plan

    points = np.empty((0, 3), np.float32) if scene.points is None else scene.points.positions
    return plan(Wish.of(str(path), frames, None, size), scene, points).views


def write_video(file: PathLike, images: "Iterable[NDArray[np.generic]]", fps: float = 30) -> int:
    """Write pictures, [height, width, 3] in [0, 1] or uint8, as .webm or .mp4; return their number.

    Raises ConfigError for another suffix and for sizes that are odd, ValueError for pictures of different sizes.
    """
    from clsplat.viewer.video.encoding import write_all

    return write_all(Path(file), images, fps)


def write_cameras(
    scene: "PathLike | Scene",
    out: PathLike,
    format: Literal["colmap", "nerfstudio", "inria"] = "colmap",
    images: Literal["none", "copy"] = "none",
) -> list[Path]:
    """Write the cameras of a dataset or a run folder for other programs, as `clsplat data cameras` does.

    format: sparse/0/*.txt of COLMAP, transforms.json of nerfstudio, or cameras.json of the reference implementation;
    images: copy the photographs to out/images, too.  Returns the files of cameras.  Raises DataError for a lens that
    the format cannot hold, ConfigError where a file is there.
    """
    from clsplat.runs import model_file
    from clsplat.scene.scene import Scene

    load_plugins()
    return model_file.write_cameras(scene if isinstance(scene, Scene) else Path(scene), Path(out), format, images)
