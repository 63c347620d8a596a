"""Make COLMAP models and write them, binary or text: the inverse of the reader, written independently of it."""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5}
IDS |= {"FULL_OPENCV": 6, "FOV": 7, "SIMPLE_DIVISION": 12, "FISHEYE": 15, "EUCM": 16, "EQUIRECTANGULAR": 17}


@dataclass
class CameraEntry:
    number: int
    model: str
    width: int
    height: int
    params: Sequence[float]


@dataclass
class ImageEntry:
    name: str
    camera: int = 1
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    translation: Sequence[float] = (0.0, 0.0, 0.0)
    points2d: int = 0


@dataclass
class PointEntry:
    position: Sequence[float]
    rgb: Sequence[int] = (255, 0, 51)
    track: int = 0


@dataclass
class ColmapModel:
    cameras: Sequence[CameraEntry]
    images: Sequence[ImageEntry]
    points: Sequence[PointEntry] = ()


PINHOLE = CameraEntry(1, "PINHOLE", 64, 48, (50.0, 51.0, 30.5, 25.25))


def tiny_model() -> ColmapModel:
    """One camera, three images and three points, with and without observations."""
    images = [
        ImageEntry("b.jpg", 1, (0.5, 0.5, -0.5, 0.5), (1.0, 2.0, 3.0), points2d=2),
        ImageEntry("a.jpg", 1, (2.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
        ImageEntry("c.jpg", 1, (0.0, 1.0, 0.0, 0.0), (4.0, 0.0, 0.0), points2d=1),
    ]
    points = [PointEntry((1.0, 2.0, 3.0), (255, 0, 51), track=2), PointEntry((-1.0, 0.5, 9.0)), PointEntry((7, 8, 9))]
    return ColmapModel([PINHOLE], images, points)


numbers = st.floats(-1e6, 1e6)
names = st.text("abc é日 .", min_size=1, max_size=8).map(lambda s: s.strip(" .") + ".jpg")


@st.composite
def models(draw: st.DrawFn) -> ColmapModel:
    """Generate models whose cameras have no distortion."""
    focal = st.floats(1.0, 1e5)
    size = st.integers(1, 10_000)
    cameras = []
    for number in draw(st.lists(st.integers(1, 99), min_size=1, max_size=3, unique=True)):
        model = draw(st.sampled_from(["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"]))
        single = model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
        zeros = {"SIMPLE_RADIAL": 1, "RADIAL": 2, "OPENCV": 4, "FULL_OPENCV": 8}.get(model, 0)
        focals = [draw(focal)] if single else [draw(focal), draw(focal)]
        params = [*focals, draw(numbers), draw(numbers), *[0.0] * zeros]
        cameras.append(CameraEntry(number, model, draw(size), draw(size), params))
    image = st.builds(
        ImageEntry,
        st.builds(lambda folder, name: folder + name, st.sampled_from(["", "left/", "deep/er/"]), names),
        st.sampled_from([camera.number for camera in cameras]),
        st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1),
        st.tuples(numbers, numbers, numbers),
        st.integers(0, 3),
    )
    images = draw(st.lists(image, min_size=2, max_size=6, unique_by=lambda i: i.name))
    byte = st.integers(0, 255)
    point = st.builds(PointEntry, st.tuples(*[numbers] * 3), st.tuples(byte, byte, byte), st.integers(0, 3))
    return ColmapModel(cameras, images, draw(st.lists(point, max_size=5)))


def write_model(folder: Path, model: ColmapModel, kind: str = "bin", newline: str = "\n") -> Path:
    """Write `cameras`, `images` and `points3D` as `kind` (bin or txt) and return the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for stem, binary, text in (
        ("cameras", _cameras_binary, _cameras_text),
        ("images", _images_binary, _images_text),
        ("points3D", _points_binary, _points_text),
    ):
        data = binary(model) if kind == "bin" else newline.join(["# a comment", *text(model), ""]).encode()
        (folder / f"{stem}.{kind}").write_bytes(data)
    return folder


def write_scene(path: Path, model: ColmapModel, kind: str = "bin", newline: str = "\n") -> Path:
    """Write the model to sparse/0, an empty file for each image, and return the scene's folder."""
    write_model(path / "sparse" / "0", model, kind, newline)
    for image in model.images:
        file = path / "images" / image.name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    return path


def _cameras_binary(model: ColmapModel) -> bytes:
    rows = [
        struct.pack(f"<IiQQ{len(c.params)}d", c.number, IDS[c.model], c.width, c.height, *c.params)
        for c in model.cameras
    ]
    return struct.pack("<Q", len(rows)) + b"".join(rows)


def _images_binary(model: ColmapModel) -> bytes:
    rows = []
    for number, image in enumerate(model.images, start=1):
        head = struct.pack("<I7dI", number, *image.quaternion, *image.translation, image.camera)
        points = struct.pack("<Q", image.points2d) + struct.pack("<ddq", 1.5, 2.5, -1) * image.points2d
        rows.append(head + image.name.encode() + b"\0" + points)
    return struct.pack("<Q", len(rows)) + b"".join(rows)


def _points_binary(model: ColmapModel) -> bytes:
    rows = []
    for number, point in enumerate(model.points, start=1):
        head = struct.pack("<Q3d3BdQ", number, *point.position, *point.rgb, 0.5, point.track)
        rows.append(head + struct.pack("<II", 1, 0) * point.track)
    return struct.pack("<Q", len(rows)) + b"".join(rows)


def _words(*values: object) -> str:
    return " ".join(str(value) for value in values)


def _cameras_text(model: ColmapModel) -> list[str]:
    return [_words(c.number, c.model, c.width, c.height, *c.params) for c in model.cameras]


def _images_text(model: ColmapModel) -> list[str]:
    lines = []
    for number, image in enumerate(model.images, start=1):
        lines.append(_words(number, *image.quaternion, *image.translation, image.camera, image.name))
        lines.append(" ".join(["1.5 2.5 -1"] * image.points2d))
    return lines


def _points_text(model: ColmapModel) -> list[str]:
    rows = enumerate(model.points, start=1)
    return [_words(i, *point.position, *point.rgb, 0.5, *[1, 0] * point.track) for i, point in rows]
