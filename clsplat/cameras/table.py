"""The formats of cameras, by name."""

import logging
import shutil
from collections.abc import Callable
from pathlib import Path

from clsplat.cameras import colmap, inria, nerfstudio
from clsplat.cameras.posed import IMAGES, Posed, image_files, posed
from clsplat.errors import ConfigError, DataError, quoted
from clsplat.files import atomic, is_there
from clsplat.progress import counted
from clsplat.reading import opened
from clsplat.scene.exif import BESIDE, write_exposures
from clsplat.scene.exposures import camera_exposures
from clsplat.scene.scene import PointCloud, Scene
from clsplat.scene.tracks import Tracks

LOG = logging.getLogger("clsplat")
WRITERS: dict[str, Callable[[Path, list[Posed], PointCloud | None, Tracks | None], list[Path]]] = {
    "colmap": colmap.write,
    "nerfstudio": nerfstudio.write,
    "inria": inria.write,
}
CHECKS: dict[str, Callable[[list[Posed]], None]] = {  # what a format cannot hold
    "colmap": colmap.check,
    "nerfstudio": nerfstudio.check,
    "inria": lambda views: None,
}
PLACES = {  # that each writes
    "colmap": [colmap.MODEL / name for name in ("cameras.txt", "images.txt", "points3D.txt")],
    "nerfstudio": [Path(nerfstudio.FILE), Path(nerfstudio.POINTS)],
    "inria": [Path(inria.FILE)],
}
UNDISTORTED = ("inria",)  # formats of cameras without lenses
COPIES = ("none", "copy")  # of the photographs
SPLIT = "nerfstudio"  # what keeps it, and times
TRACKS = "colmap"  # what keeps which points the photographs show


def checked(scene: Scene, format_: str) -> list[Posed]:
    """Return the views as a format names them.  Raises DataError for what it cannot hold."""
    views = posed(scene)
    CHECKS[format_](views)
    return views


def write_cameras(scene: Scene, out: Path, format_: str, images: str = "none", over: bool = False) -> list[Path]:
    """Write the cameras of a scene, and the photographs where they are to be copied, with what their cameras noted of
    the exposures; return the files of cameras.

    The views have the size of the dataset.  over: whether files there may be replaced.
    Raises ConfigError for another name and where a file is there, DataError where the format cannot hold the scene.
    """
    for what, value, known in (("format", format_, tuple(WRITERS)), ("images", images, COPIES)):
        if value not in known:
            raise ConfigError(f"no {what} {quoted(value)}; there are {', '.join(known)}")
    views = checked(scene, format_)
    if images == "copy" and format_ in UNDISTORTED and any(one.view.lens is not None for one in views):
        raise DataError(
            f"{scene.path}: {format_} holds cameras of undistorted photographs, and these are distorted; "
            "`clsplat data undistort` first, or write the cameras alone"
        )
    copies = image_files(views, out / IMAGES) if images == "copy" else {}
    beside = [out / IMAGES / BESIDE] if copies else []
    for path in () if over else (*(out / place for place in PLACES[format_]), *copies, *beside):
        if is_there(path):
            raise ConfigError(f"{path}: exists; give another folder for the cameras, or remove it")
    written = WRITERS[format_](out, views, scene.points, scene.tracks)
    if format_ != SPLIT and scene.test:
        lost = f"{len(scene.test)} of {len(views)}"
        LOG.warning("%s: %s does not keep which views are for testing, %s; %s does", out, format_, lost, SPLIT)
    if format_ != SPLIT and any(one.view.time is not None for one in views):
        LOG.warning("%s: %s does not keep the times of the views; %s does", out, format_, SPLIT)
    if format_ != TRACKS and copies and scene.tracks is not None:
        LOG.warning("%s: %s does not keep which points the photographs show; %s does", out, format_, TRACKS)
    for path, source in counted(copies.items(), "photographs copied", len(copies)):
        with opened(source, "an image") as old, atomic(path) as new:
            shutil.copyfileobj(old, new)
    if copies:
        found = camera_exposures([one.view for one in views])
        write_exposures(out / IMAGES, {one.name: exposure for one, exposure in zip(views, found, strict=True)})
    return written
