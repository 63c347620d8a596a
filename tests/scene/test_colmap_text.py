"""COLMAP's text files: dialects, and errors with the line."""

from pathlib import Path

import numpy as np
import pytest

from clsplat.scene.detect import read_scene
from tests.support.refusals import refusal

TEXT = {
    "cameras.txt": "# cameras\n1 PINHOLE 64 48 50 51 30.5 25.25\n",
    "images.txt": "# images\n1 1 0 0 0 0 0 1 1 a.jpg\n1 2 -1 3 4 7\n2 0 1 0 0 4 0 0 1 b c.jpg\n\n",
    "points3D.txt": "1 1 2 3 255 0 51 0.5 1 0 2 1\n2 4 5 6 0 0 0 0.5\n",
}


def write_text(path: Path, **changes: str) -> Path:
    """Write TEXT as a scene, with other contents for some of its files."""
    model = path / "sparse" / "0"
    model.mkdir(parents=True)
    for name, text in TEXT.items():
        (model / name).write_bytes(changes.get(name.removesuffix(".txt"), text).encode())
    for name in ("a.jpg", "b c.jpg"):
        (path / "images").mkdir(exist_ok=True)
        (path / "images" / name).touch()
    return path


@pytest.mark.parametrize(
    "edit",
    [
        str,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: "\ufeff" + text,
        lambda text: " # more\n\n" + text + "\n# end\n",
        lambda text: text.replace("1 2 -1 3 4 7\n", "\n"),  # no observations: a blank line
        lambda text: text.replace("1 2 -1 3 4 7\n", "").removesuffix("\n"),  # no observations: no line at all
    ],
    ids=["plain", "crlf", "bom", "comments", "blank", "omitted"],
)
def test_text_dialects_give_the_same_scene(tmp_path: Path, edit) -> None:
    files = {name.removesuffix(".txt"): edit(text) for name, text in TEXT.items()}
    scene = read_scene(write_text(tmp_path, **files))
    assert [view.name for view in scene.views] == ["a.jpg", "b c.jpg"]
    np.testing.assert_allclose(scene.views[1].world_to_camera[:, :3], np.diag([1, -1, -1]))
    assert scene.points is not None
    np.testing.assert_array_equal(scene.points.positions, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("file", "old", "new", "place"),
    [
        ("images", "0 0 0 0 0 1 1 a", "-nan(ind) 0 0 0 0 1 1 a", "images.txt: line 2"),
        ("images", "0 0 0 0 0 1 1 a", "nan 0 0 0 0 1 1 a", "images.txt: line 2"),
        ("images", "4 0 0 1 b", "4 inf 0 1 b", "images.txt: line 4"),
        ("images", "2 0 1 0 0 4", "2 0 0 0 0 4", "images.txt: line 4"),
        ("images", "1 a.jpg", "5 a.jpg", "has camera 5"),
        ("images", "1 a.jpg", "", "images.txt: line 2"),
        ("images", "1 2 -1 3 4 7", "1 2 -1 3", "images.txt: line 3"),
        ("cameras", "50 51", "-nan(ind) 51", "cameras.txt: line 2"),
        ("cameras", "50 51", "nan 51", "cameras.txt: line 2"),
        ("cameras", "50 51", "50 -51", "cameras.txt: line 2"),
        ("cameras", "50 51", "50", "cameras.txt: line 2"),
        ("cameras", "64 48", "64 0", "cameras.txt: line 2"),
        ("cameras", "64 48", "64 48.5", "cameras.txt: line 2"),
        ("cameras", "PINHOLE", "PINHOLES", "PINHOLES"),
        ("cameras", "25.25\n", "25.25\n1 PINHOLE 64 48 50 51 30.5 25.25\n", "cameras.txt: line 3"),
        ("points3D", "4 5 6", "4 -nan(ind) 6", "points3D.txt: line 2"),
        ("points3D", "255 0 51", "256 0 51", "points3D.txt: line 1"),
        ("points3D", "0 0 0 0.5", "0 0 0", "points3D.txt: line 2"),
    ],
)
def test_text_error_names_the_line(tmp_path: Path, file: str, old: str, new: str, place: str) -> None:
    text = TEXT[f"{file}.txt"]
    assert text.count(old) == 1
    assert place in refusal(read_scene, write_text(tmp_path, **{file: text.replace(old, new)}))


def test_text_that_is_not_utf8(tmp_path: Path) -> None:
    write_text(tmp_path)
    (tmp_path / "sparse" / "0" / "images.txt").write_bytes(b"1 1 0 0 0 0 0 1 1 \xff.jpg\n")
    assert "images.txt: not UTF-8" in refusal(read_scene, tmp_path)
