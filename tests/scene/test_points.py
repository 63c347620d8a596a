"""Sparse points as PLY files."""

import struct
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from clsplat.scene.detect import read_scene
from clsplat.scene.points import read_points_ply, write_points_ply
from clsplat.scene.scene import PointCloud
from tests.support.data_sets import data_set
from tests.support.refusals import refusal
from tests.support.transforms_scene import LENS, frames, write

LITTLE = "binary_little_endian"
ROWS = np.array([[1, 2, 3, 255, 0, 51], [-4, 0.5, 1e-3, 0, 1, 2]])


def ply(form: str, properties: list[tuple[str, str]], rows, count: int | None = None, after: bytes = b"") -> bytes:
    """Build a PLY from (struct letter, name) properties."""
    names = {"f": "float", "d": "double", "B": "uchar", "i": "int"}
    header = ["ply", f"format {form} 1.0", "comment made by a test"]
    header += [f"element vertex {len(rows) if count is None else count}"]
    header += [f"property {names[letter]} {name}" for letter, name in properties]
    head = "\n".join([*header, "end_header", ""]).encode()
    letters = [letter for letter, _ in properties]
    rows = [[int(v) if letter in "Bi" else v for letter, v in zip(letters, row, strict=True)] for row in rows]
    if form == "ascii":
        return head + "".join(" ".join(map(str, row)) + "\n" for row in rows).encode() + after
    return head + b"".join(struct.pack("<" + "".join(letters), *row) for row in rows) + after


PLAIN = [*[("f", name) for name in "xyz"], *[("B", name) for name in ("red", "green", "blue")]]


@pytest.mark.parametrize(
    ("dialect", "form"),
    [*(("plain", "ascii"), ("double", LITTLE), ("extra", "ascii"), ("extra", LITTLE), ("order", LITTLE))],
)
def test_ply_dialects_give_the_same_points(tmp_path: Path, form: str, dialect: str) -> None:
    properties, rows = list(PLAIN), ROWS
    if dialect == "double":
        properties[:3] = [("d", name) for name in "xyz"]
    if dialect == "extra":
        properties[3:3] = [("f", "nx"), ("i", "label")]
        rows = np.insert(ROWS, [3, 3], 7, axis=1)
    if dialect == "order":
        order = [5, 4, 3, 2, 0, 1]
        properties, rows = [PLAIN[i] for i in order], ROWS[:, order]
    path = tmp_path / "p.ply"
    path.write_bytes(ply(form, properties, rows))
    points = read_points_ply(path)
    np.testing.assert_array_equal(np.float32(points.positions), np.float32(ROWS[:, :3]))
    np.testing.assert_allclose(points.colors, ROWS[:, 3:] / 255, atol=1e-7)


def test_ply_with_crlf_header_and_faces(tmp_path: Path) -> None:
    path = tmp_path / "p.ply"
    data = ply("ascii", PLAIN, ROWS, after=b"3 0 1 1 0.5\n")
    faces = b"element face 1\nproperty list uchar int vertex_index\nproperty float area\nend_header"
    path.write_bytes(data.replace(b"end_header", faces).replace(b"\n", b"\r\n"))
    assert len(read_points_ply(path)) == 2


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_with_other_elements_before_the_vertices(tmp_path: Path, form: str) -> None:
    header, body = ply(form, PLAIN, ROWS).split(b"end_header\n")
    before, vertex = header.split(b"element vertex")
    cameras = b"element camera 2\nproperty float focal\nproperty uchar kind\n"
    values = b"1.5 1\n2.5 0\n" if form == "ascii" else struct.pack("<fBfB", 1.5, 1, 2.5, 0)
    path = tmp_path / "p.ply"
    path.write_bytes(before + cameras + b"element vertex" + vertex + b"end_header\n" + values + body)
    np.testing.assert_array_equal(read_points_ply(path).positions, np.float32(ROWS[:, :3]))
    path.write_bytes(path.read_bytes().replace(b"camera 2", b"camera 999999999999999999"))
    refusal(read_points_ply, path)
    lists = cameras.replace(b"property uchar", b"property list uchar int")
    path.write_bytes(before + lists + b"element vertex" + vertex + b"end_header\n" + values + body)
    assert "the element 'camera' has a list and precedes the vertices" in refusal(read_points_ply, path)


def test_ply_written_and_read(tmp_path: Path) -> None:
    cloud = PointCloud(np.float32(ROWS[:, :3]), np.float32(ROWS[:, 3:] / 255))
    write_points_ply(tmp_path / "new" / "p.ply", cloud)
    points = read_points_ply(tmp_path / "new" / "p.ply")
    np.testing.assert_array_equal(points.positions, cloud.positions)
    np.testing.assert_array_equal(points.colors, cloud.colors)


def test_every_level_survives_writing(tmp_path: Path) -> None:
    levels = np.arange(256)
    write_points_ply(tmp_path / "p.ply", PointCloud(np.zeros((256, 3), np.float32), np.float32([levels] * 3).T / 255))
    np.testing.assert_array_equal(np.rint(read_points_ply(tmp_path / "p.ply").colors[:, 1] * 255), levels)


def test_colors_are_rounded(tmp_path: Path) -> None:
    write_points_ply(tmp_path / "p.ply", PointCloud(np.zeros((1, 3), np.float32), np.float32([[0.999, 0.5, 0.001]])))
    assert (read_points_ply(tmp_path / "p.ply").colors * 255).round().tolist() == [[255, 128, 0]]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_ply_without_points_is_read_silently(tmp_path: Path, form: str, recwarn: pytest.WarningsRecorder) -> None:
    (tmp_path / "p.ply").write_bytes(ply(form, PLAIN, []))
    assert len(read_points_ply(tmp_path / "p.ply")) == 0
    assert not recwarn


def test_points_of_a_real_ply_are_plausible() -> None:
    points = read_points_ply(data_set("fox_peers") / "points_10k.ply")
    assert len(points) == 10_000
    assert np.ptp(points.positions, axis=0).min() > 1
    assert 0.1 < points.colors.mean() < 0.9


DAMAGE = [
    (b"ply\n", b"pla\n"),
    (b"end_header", b"the_end"),
    (b"binary_little_endian", b"binary_big_endian"),
    (b"format binary_little_endian 1.0\n", b""),
    (b"element vertex 2", b"element vertex two"),
    (b"element vertex 2", b"element vertex -2"),
    (b"element vertex 2", b"element vertex 3"),
    (b"element vertex 2", b"element vertex 1152921504606846976"),
    (b"element vertex 2", b"element vertex " + b"9" * 5000),
    (b"element vertex 2", b"element face 2"),
    (b"float y", b"float x"),
    (b"float y", b"float w"),
    (b"float y", b"quad y"),
    (b"float y", b"list uchar float y"),
    (b"end_header", b"property list uchar int neighbors\nend_header"),
    (b"uchar green", b"float green"),
]


@pytest.mark.parametrize(
    ("old", "new", "form"), [(*one, form) for one, form in zip(DAMAGE, cycle(("ascii", LITTLE)), strict=False)]
)
def test_damaged_ply_is_refused(tmp_path: Path, form: str, old: bytes, new: bytes) -> None:
    data = ply(form, PLAIN, ROWS)
    path = tmp_path / "p.ply"
    old, new = (text.replace(b"binary_little_endian", form.encode()) for text in (old, new))
    assert old in data
    path.write_bytes(data.replace(old, new, 1))
    assert "p.ply: " in refusal(read_points_ply, path)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_truncated_ply_is_refused(tmp_path: Path, form: str) -> None:
    data = ply(form, PLAIN, ROWS)
    path = tmp_path / "p.ply"
    # In text, a cut inside the last number cannot be detected.
    for length in range(len(data) - (2 if form == "ascii" else 0)):
        path.write_bytes(data[:length])
        refusal(read_points_ply, path)


@pytest.mark.parametrize("line", [b"1 2 x 4 5 6", b"1 2 3 4 5", b"1 2 3 400 5 6", b"1 2 3 4.5 5 6"])
def test_ascii_ply_with_a_wrong_line(tmp_path: Path, line: bytes) -> None:
    path = tmp_path / "p.ply"
    path.write_bytes(ply("ascii", PLAIN, [], count=2) + b"1 2 3 4 5 6\n" + line + b"\n")
    refusal(read_points_ply, path)


# ---- beside a transforms.json

CLOUD = PointCloud(np.float32([[1, 2, 3]]), np.float32([[1, 0, 0.2]]))


@pytest.mark.parametrize(
    ("name", "file", "keys"),
    [
        ("transforms_train.json", "points3d.ply", {}),
        ("transforms.json", "a/p.ply", {"ply_file_path": "./a/p.ply"}),
    ],
)
def test_points_are_read_with_a_transforms_file(tmp_path: Path, name: str, file: str, keys: dict) -> None:
    write(tmp_path, name, **LENS, **keys, frames=frames("a.png", "b.png"))
    write_points_ply(tmp_path / file, CLOUD)
    points = read_scene(tmp_path).points
    assert points is not None
    np.testing.assert_array_equal(points.positions, CLOUD.positions)


@pytest.mark.parametrize("value", ["../p.ply", "none.ply", 3])
def test_missing_points_file_is_refused(tmp_path: Path, value) -> None:
    refusal(read_scene, write(tmp_path, **LENS, ply_file_path=value, frames=frames("a.png", "b.png")))


def test_points_file_without_points(tmp_path: Path) -> None:
    write(tmp_path, **LENS, frames=frames("a.png", "b.png"))
    write_points_ply(tmp_path / "points3d.ply", PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.float32)))
    assert read_scene(tmp_path).points is None
