"""Read videos of several fixed cameras: a folder of frames per camera, next to COLMAP or nerfstudio cameras."""

import logging
import os
import re
from dataclasses import replace
from pathlib import Path, PureWindowsPath

from clsplat.core.errors import DataError, first_few, shell_quote
from clsplat.scene.colmap import find_models, read_camera_views, read_images
from clsplat.scene.images import is_image, read_stored_size
from clsplat.scene.reader import Reader
from clsplat.scene.scene import PointCloud, Scene, every_nth, make_scene
from clsplat.scene.times import Clock
from clsplat.scene.transforms_json import TRANSFORMS_FILE as TRANSFORMS
from clsplat.scene.transforms_json import Transforms, make_view, view_name
from clsplat.scene.view import View

LOG = logging.getLogger("clsplat")
VIDEOS, STATIC = "videos", "static"
VIDEO_SUFFIXES = frozenset({".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v"})  # in lower case


class MulticameraReader(Reader):
    """Synchronized videos of fixed cameras: frames in `videos/NAME`, cameras in `sparse` or transforms.json.

    Camera NAME has the pose of the image `NAME.png` (with any suffix, in any folder), or of an image in a folder NAME.
    Frames are sorted by name, with 10 after 9; the i-th frames of all cameras have the same timestamp.  Every
    `holdout`-th camera in order of name is a test camera.  A mask `static/NAME.png` is white in pixels without motion.
    """

    name = "multi-camera video"
    expects = f"{VIDEOS}/ next to sparse/0 or {TRANSFORMS}"

    def matches(self, path: Path) -> bool:
        """Return whether an entry of `videos` has the name of a camera.  Other scenes may keep source videos there."""
        names = {entry.name if entry.is_dir() else entry.stem for entry in _list_entries(path)}
        return bool(names) and not names.isdisjoint(_find_camera_names(path))

    def read(self, path: Path, holdout: int) -> Scene:
        frames = _find_frames(path)
        cameras, points = _read_camera_views(path, frames)
        test = every_nth(sorted(cameras), holdout)
        views, test_indices = list[View](), set[int]()
        for number, (name, camera) in enumerate(sorted(cameras.items())):
            count, mask = len(frames[name]), path / STATIC / f"{name}.png"
            for i, file in enumerate(frames[name]):
                test_indices |= {len(views)} if number in test else set()
                time, static_path = i / (count - 1), mask if os.path.isfile(mask) else None
                view = replace(camera, name=f"{name}/{file.name}", image_path=file, mask_path=None)
                views.append(replace(view, time=time, static_path=static_path))
        return make_scene(path, views, test_indices, points)


def _candidate_names(image: str) -> tuple[str, str]:
    """Return the possible camera names of an image: its name without the suffix, and the name of its folder."""
    name = PureWindowsPath(image)
    return name.stem, name.parent.name


def _list_entries(path: Path) -> list[Path]:
    """Return the entries of the folder `videos`, sorted by name; empty if the folder does not exist."""
    folder = path / VIDEOS
    return sorted(entry for entry in folder.iterdir() if entry.name[0] != ".") if folder.is_dir() else []


def _find_camera_names(path: Path) -> set[str]:
    """Return the possible camera names of a dataset, or an empty set if a file is damaged (other readers report it)."""
    try:
        if (path / TRANSFORMS).is_file():
            paths = [frame.value("file_path") for frame in Transforms(path / TRANSFORMS).frames]
            images = [view_name(file) for file in paths if isinstance(file, str)]
        else:
            images = [image.name for model in find_models(path) for image in read_images(model)]
    except DataError:
        return set()
    return {name for image in images for name in _candidate_names(image)}


def _find_frames(path: Path) -> dict[str, list[Path]]:
    """Return the sorted frames of each camera.  Raises DataError unless the numbers are equal and at least 2."""
    entries = _list_entries(path)
    frames = {
        entry.name: sorted(filter(is_image, entry.iterdir()), key=_natural_order) for entry in entries if entry.is_dir()
    }
    empty_names = [name for name, files in frames.items() if not files]
    frames = {name: files for name, files in frames.items() if files}
    videos = [entry for entry in entries if entry.suffix.lower() in VIDEO_SUFFIXES and entry.stem not in frames]
    if videos:
        folder = videos[0].with_suffix("")
        raise DataError(
            f"{videos[0]}: has no folder {folder} with its frames; create the folder and extract the frames, for "
            f"example with `ffmpeg -i {shell_quote(videos[0])} -r 10 {shell_quote(folder / '%04d.png')}`"
        )
    if not frames:
        raise DataError(f"{path / VIDEOS}: has no folders of frames; expected {VIDEOS}/NAME/0000.png … for each camera")
    if empty_names:
        raise DataError(
            f"{path / VIDEOS}: {len(empty_names)} of {len(entries)} cameras have no frames: {first_few(empty_names)}; "
            "expected images in each folder: add them, or remove the empty folders"
        )
    counts = {name: len(files) for name, files in frames.items()}
    short, long = (select(counts, key=counts.__getitem__) for select in (min, max))
    if counts[short] != counts[long]:
        raise DataError(
            f"{path / VIDEOS}: {short} has {counts[short]} frames, {long} has {counts[long]}; expected the same "
            "number of frames from every camera: trim the videos to the same start and end, and use the same frame rate"
        )
    if counts[short] < 2:
        raise DataError(f"{path / VIDEOS}: has one frame per camera; expected at least two")
    return frames


def _natural_order(frame: Path) -> list[tuple[int, str]]:
    """Return a key that sorts frame names in natural order, with 10 after 9."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", frame.name)]


def _read_camera_views(path: Path, frames: dict[str, list[Path]]) -> tuple[dict[str, View], PointCloud | None]:
    """Return a view for each camera with frames, and the points.  Raises DataError for a camera without a pose."""
    if (path / TRANSFORMS).is_file():
        transforms = Transforms(path / TRANSFORMS)
        first_frame = next(iter(frames.values()))[0]
        size = read_stored_size(first_frame)
        views = [make_view(frame, frame.image_name(), size) for frame in transforms.frames]
        points = transforms.read_points(Clock(0.0, 1.0))
    else:
        views, points = read_camera_views(path)
    cameras: dict[str, View] = {}
    for view in views:
        name = next((name for name in _candidate_names(view.name) if name in frames), None)
        if name is None:
            continue
        if name in cameras:
            pair = f"{cameras[name].name} and {view.name}"
            raise DataError(f"{path}: {pair} are both poses of camera {name}; expected one pose per camera: remove one")
        cameras[name] = view
    if missing_names := sorted(set(frames) - set(cameras)):
        raise DataError(
            f"{path}: {len(missing_names)} of {len(frames)} cameras have no pose: {first_few(missing_names)}; "
            f"expected a pose of the image NAME.png for each camera; add it, or remove {VIDEOS}/{missing_names[0]}"
        )
    if len(views) > len(cameras):
        LOG.info("%s: skipped %d images of cameras without frames in %s", path, len(views) - len(cameras), VIDEOS)
    return cameras, points
