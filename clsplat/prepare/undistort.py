"""Convert a scene to pinhole cameras: undistorted photographs, smaller on request, and their masks."""

import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import atomic
from clsplat.core.manifest import Made, hash_of
from clsplat.core.progress import Count
from clsplat.core.quaternions import unit_quaternions
from clsplat.scene.camera import Camera, shared
from clsplat.scene.colmap import POINT2D
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_exposures, write_image
from clsplat.scene.scene import PointCloud, Tracks
from clsplat.scene.times_file import write_times
from clsplat.scene.view import View, camera_exposures, load_image, load_mask

# Write a COLMAP model of pinhole cameras: cameras.bin, images.bin, points3D.bin.

PINHOLE = 1  # COLMAP's number of the model
NONE, EXACTLY = np.empty(0, np.int64), np.zeros((1, 2))


def write_model(folder: Path, views: Sequence[View], points: PointCloud | None, tracks: Tracks | None = None) -> None:
    """Write `views`, whose names are those of their images, and points; cameras that are equal are one.

    tracks: which of the points, in their order, each view shows; their places in an image are where the camera projects
    them to, and as far from there as they were in the photograph.  Raises OutputError.
    """
    cameras: dict[Camera, int] = {}
    for view in views:
        cameras.setdefault(view.camera, len(cameras) + 1)
    seen = {view.name: tracks.seen.get(view.name, NONE) if tracks and points else NONE for view in views}
    rows = [_camera(number, camera) for camera, number in cameras.items()]
    _write(folder / "cameras.bin", rows)
    missed = {
        view.name: tracks.misses.get(view.name, EXACTLY) / view.downscale if tracks else EXACTLY for view in views
    }
    images = [
        _image(i, view, cameras[view.camera], _colmap_writer_shown(points, seen[view.name], view, missed[view.name]))
        for i, view in enumerate(views, 1)
    ]
    _write(folder / "images.bin", images)
    _write(folder / "points3D.bin", [] if points is None else _points(points, list(seen.values())))


def _write(path: Path, rows: Sequence[bytes]) -> None:
    with atomic(path) as file:
        file.write(struct.pack("<Q", len(rows)) + b"".join(rows))


def _camera(number: int, camera: Camera) -> bytes:
    params = camera.fx, camera.fy, camera.cx, camera.cy
    return struct.pack("<IiQQ4d", number, PINHOLE, camera.width, camera.height, *params)


def _image(number: int, view: View, camera: int, shown: NDArray[Any]) -> bytes:
    quaternion = unit_quaternions(view.world_to_camera[:, :3])
    pose = struct.pack("<I7dI", number, *quaternion, *view.world_to_camera[:, 3], camera)
    return pose + view.name.encode() + b"\0" + struct.pack("<Q", len(shown)) + shown.tobytes()


def _colmap_writer_shown(
    points: PointCloud | None, rows: NDArray[np.int64], view: View, missed: NDArray[np.floating]
) -> NDArray[Any]:
    """The 2D points of a view; missed: [K or 1, 2] px from where it projects them to."""
    table = np.zeros(len(rows), POINT2D)
    if points is not None:
        table["point"] = rows + 1
        places = points.positions[rows] @ view.world_to_camera[:, :3].T + view.world_to_camera[:, 3]
        depth = np.where(places[:, 2] > 0, places[:, 2], 1)
        focal, centre = (view.camera.fx, view.camera.fy), (view.camera.cx, view.camera.cy)
        table["xy"] = places[:, :2] / depth[:, None] * focal + centre + np.nan_to_num(missed)
    return table


def _points(points: PointCloud, seen: Sequence[NDArray[np.int64]]) -> list[bytes]:
    """seen: the rows of points that each image shows, by its number less 1."""
    tracks: list[bytes] = [b""] * len(points)
    for number, rows in enumerate(seen, 1):
        for place, row in enumerate(rows):
            tracks[row] += struct.pack("<II", number, place)
    rgb = np.rint(points.colours * 255).astype(np.uint8)
    table = zip(points.positions.astype(float), rgb, tracks, strict=True)
    return [
        struct.pack("<Q3d3BdQ", i, *position, *colour, 0.0, len(track) // 8) + track
        for i, (position, colour, track) in enumerate(table, 1)
    ]


Blank = Literal["crop", "mask"]


def undistort_scene(source: Path, out: Path, long_side: int | None = None, blank: Blank = "crop") -> int:
    """Write a COLMAP scene of pinhole cameras into `out`; return the number of its images.

    Photographs larger than `long_side` px are made smaller.  `blank: crop` keeps the largest part of a photograph
    without blank pixels; `mask` keeps all of it, with masks of blank pixels.  Images that an earlier call has made of
    the same photographs with the same settings stay unchanged.
    Raises DataError when the scene cannot be read, or when an image in `out` has another origin.
    """
    scene = read_scene(source, holdout=0)
    names, made = _png_names([view.name for view in scene.views]), Made(out)
    for name in names:
        made.require_own(out / "images" / name)
    views, count = [], Count("photographs undistorted", len(names))
    for number, (view, name) in enumerate(zip(scene.views, names, strict=True), 1):
        pinhole_view = replace(_sized(_shown(view, blank), long_side), alpha="mask")
        image, mask = out / "images" / name, out / "masks" / name
        if made.is_due(image, _source(pinhole_view), mask):
            counts = load_mask(pinhole_view)
            if counts is not None and not counts.all():
                write_image(mask, np.repeat(np.where(counts, 255, 0).astype(np.uint8)[:, :, None], 3, axis=2))
            write_image(image, load_image(pinhole_view))
        views.append(replace(pinhole_view, name=name))
        count.reach(number)
    write_exposures(out / "images", dict(zip(names, camera_exposures(scene.views), strict=True)))
    if times := {name: view.time for view, name in zip(scene.views, names, strict=True) if view.time is not None}:
        write_times(out / "images", times)
    tracks = scene.tracks and scene.tracks.renamed({v.name: name for v, name in zip(scene.views, names, strict=True)})
    write_model(out / "sparse" / "0", views, scene.points, tracks)
    return len(views)


def _source(view: View) -> str:
    """A hash of all that decides over the pixels of an undistorted image and its mask."""
    files = [view.image_path, *([view.mask_path] if view.mask_path else [])]
    return hash_of(*files, view.lens, view.camera)


def _shown(view: View, blank: Blank) -> View:
    if view.lens is None or blank == "crop":
        return view
    lens = shared(replace(view.lens, whole=True))
    return replace(view, lens=lens, camera=lens.pinhole)


def _sized(view: View, long_side: int | None) -> View:
    """The view with no side longer than `long_side` px."""
    longest = max(view.camera.width, view.camera.height)
    return view if long_side is None else view.resized(max(1.0, longest / long_side))


def _png_names(names: list[str]) -> list[str]:
    """The names with .png for their suffix, or behind it where names would be the same."""
    short = [Path(name).with_suffix(".png").as_posix() for name in names]
    taken = Counter(short)
    chosen = [one if taken[one] == 1 else f"{name}.png" for one, name in zip(short, names, strict=True)]
    if len(set(chosen)) < len(chosen):
        raise DataError(f"two images would be called '{Counter(chosen).most_common(1)[0][0]}'; rename one")
    return chosen
