"""Read videos of several fixed cameras: a folder of frames for each, beside the cameras of COLMAP or nerfstudio."""

import logging
import os
import re
from dataclasses import replace
from pathlib import Path, PurePosixPath

from clsplat.core.errors import DataError, first_few, shell_quote
from clsplat.scene.colmap import camera_views, find_models, read_images
from clsplat.scene.images import is_image, read_header
from clsplat.scene.reader import Reader
from clsplat.scene.scene import PointCloud, Scene, every_nth, make_scene
from clsplat.scene.times import Clock
from clsplat.scene.transforms_json import TRANSFORMS_FILE as TRANSFORMS
from clsplat.scene.transforms_json import Transforms, view_name, view_of
from clsplat.scene.view import View

LOG = logging.getLogger("clsplat")
VIDEOS, STATIC = "videos", "static"
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v"})  # in lower case


class MulticameraReader(Reader):
    """Videos of fixed cameras that ran together: frames in `videos/NAME`, cameras in `sparse` or transforms.json.

    A camera is that of the image `NAME.png` (of any suffix, in any folder), or of an image in a folder NAME.  Frames
    are in order of name, in which 10 comes after 9; the i-th of each camera is of the same moment.  Every `holdout`-th
    camera by name is for testing.
    Where there is `static/NAME.png`, it is white in pixels of that camera that show nothing that moves.
    """

    name = "multi-camera video"
    expects = f"{VIDEOS}/ beside sparse/0 or {TRANSFORMS}"

    def matches(self, path: Path) -> bool:
        """Return whether something in `videos` has the name of a camera: other videos may be what a scene came from."""
        named = {entry.name if entry.is_dir() else entry.stem for entry in _entries(path)}
        return bool(named) and not named.isdisjoint(_camera_names(path))

    def read(self, path: Path, holdout: int) -> Scene:
        frames = _frames(path)
        stations, points = _stations(path, frames)
        test = every_nth(sorted(stations), holdout)
        views, held_out = list[View](), set[int]()
        for number, (name, station) in enumerate(sorted(stations.items())):
            count, still = len(frames[name]), path / STATIC / f"{name}.png"
            for i, file in enumerate(frames[name]):
                held_out |= {len(views)} if number in test else set()
                time, known = i / (count - 1), still if os.path.isfile(still) else None
                view = replace(station, name=f"{name}/{file.name}", image_path=file, mask_path=None)
                views.append(replace(view, time=time, static_path=known))
        return make_scene(path, views, held_out, points)


def names_of(image: str) -> tuple[str, str]:
    """Return the names that the camera of an image may have: that of the image, and that of its folder."""
    name = PurePosixPath(image)
    return name.stem, name.parent.name


def _entries(path: Path) -> list[Path]:
    """What `videos` of a dataset holds, by name; nothing where there is no such folder."""
    folder = path / VIDEOS
    return sorted(entry for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []


def _camera_names(path: Path) -> set[str]:
    """The names that the cameras of a dataset may have; none where files are damaged, as another reader tells."""
    try:
        if (path / TRANSFORMS).is_file():
            places = [frame.value("file_path") for frame in Transforms(path / TRANSFORMS).frames]
            images = [view_name(place) for place in places if isinstance(place, str)]
        else:
            images = [image.name for model in find_models(path) for image in read_images(model)]
    except DataError:
        return set()
    return {name for image in images for name in names_of(image)}


def _frames(path: Path) -> dict[str, list[Path]]:
    """The frames of each camera in order.  Raises DataError for videos without frames, and where numbers differ."""
    folders = _entries(path)
    frames = {
        entry.name: sorted(filter(is_image, entry.iterdir()), key=_in_order) for entry in folders if entry.is_dir()
    }
    empty = [name for name, files in frames.items() if not files]
    frames = {name: files for name, files in frames.items() if files}
    packed = [entry for entry in folders if entry.suffix.lower() in VIDEO_SUFFIXES and entry.stem not in frames]
    if packed:
        raise DataError(
            f"{packed[0]}: is a video without a folder {packed[0].with_suffix('')} of its frames; "
            f"`clsplat data sync-frames {shell_quote(path)}` writes the frames of all cameras"
        )
    if not frames:
        raise DataError(f"{path / VIDEOS}: has no folders of frames; expected {VIDEOS}/NAME/0000.png … for each camera")
    if empty:
        raise DataError(
            f"{path / VIDEOS}: {len(empty)} of {len(folders)} cameras have no frames: {first_few(empty)}; expected "
            "images in each folder: add them, or remove the folder"
        )
    counts = {name: len(files) for name, files in frames.items()}
    least, most = (of(counts, key=lambda name: counts[name]) for of in (min, max))
    if counts[least] != counts[most]:
        raise DataError(
            f"{path / VIDEOS}: {least} has {counts[least]} frames, {most} has {counts[most]}; expected the same "
            "moments of every camera: cut the videos to one start and one end, and take frames at one rate"
        )
    if counts[least] < 2:
        raise DataError(f"{path / VIDEOS}: has one frame a camera; expected two moments at least, in order of name")
    return frames


def _in_order(frame: Path) -> list[tuple[int, str]]:
    """The key of a frame in the order of names, in which 10 comes after 9."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", frame.name)]


def _stations(path: Path, frames: dict[str, list[Path]]) -> tuple[dict[str, View], PointCloud | None]:
    """A view for each camera that has frames, and the points.  Raises DataError for a camera without a pose."""
    if (path / TRANSFORMS).is_file():
        transforms = Transforms(path / TRANSFORMS)
        first = next(iter(frames.values()))[0]
        header = read_header(first)
        posed = [view_of(frame, (header.width, header.height)) for frame in transforms.frames]
        points = transforms.points(Clock(0.0, 1.0))
    else:
        posed, points = camera_views(path)
    stations: dict[str, View] = {}
    for view in posed:
        known = [name for name in names_of(view.name) if name in frames]
        if not known:
            continue
        if known[0] in stations:
            both = " and ".join((stations[known[0]].name, view.name))
            raise DataError(f"{path}: {both} are both of the camera {known[0]}; expected one pose for each: keep one")
        stations[known[0]] = view
    if without := sorted(set(frames) - set(stations)):
        raise DataError(
            f"{path}: {len(without)} of {len(frames)} cameras have no pose: {first_few(without)}; expected an image "
            f"NAME.png of each among the cameras, or remove {VIDEOS}/{without[0]}"
        )
    if len(posed) > len(stations):
        LOG.info("%s: left out %d images of no camera in %s", path, len(posed) - len(stations), VIDEOS)
    return stations, points
