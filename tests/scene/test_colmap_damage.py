"""The reader of COLMAP folders on damaged files and invalid models."""

import math
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clsplat.core.errors import DataError
from clsplat.scene.colmap import ColmapReader
from clsplat.scene.detect import read_scene
from tests.support.colmap_writer import (
    PINHOLE,
    CameraEntry,
    ColmapModel,
    ImageEntry,
    tiny_model,
    write_model,
    write_scene,
)
from tests.support.refusals import refusal

# ---- damage


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_cut_anywhere_is_a_data_error(tmp_path: Path, stem: str) -> None:
    file = write_scene(tmp_path, tiny_model()) / "sparse" / "0" / f"{stem}.bin"
    data = file.read_bytes()
    for length in range(len(data)):
        file.write_bytes(data[:length])
        message = refusal(read_scene, tmp_path)
        assert f"{stem}.bin: byte " in message, length
        assert "expected" in message


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_bytes_after_the_last_record_are_a_data_error(tmp_path: Path, stem: str) -> None:
    file = write_scene(tmp_path, tiny_model()) / "sparse" / "0" / f"{stem}.bin"
    file.write_bytes(file.read_bytes() + b"\0")
    assert "1 bytes follow" in refusal(read_scene, tmp_path)


@pytest.mark.parametrize(
    ("stem", "offset", "count"),
    [
        *(("cameras", 0, 2**60), ("images", 0, 2**63), ("points3D", 0, 2**64 - 1)),
        *(("images", 8 + 64 + len("b.jpg") + 1, 2**64 - 1), ("points3D", 8 + 43, 2**60)),
    ],
)
def test_huge_count_allocates_nothing(tmp_path: Path, stem: str, offset: int, count: int) -> None:
    file = write_scene(tmp_path, tiny_model()) / "sparse" / "0" / f"{stem}.bin"
    data = bytearray(file.read_bytes())
    assert struct.unpack_from("<Q", data, offset)[0] <= 3  # a count, indeed
    struct.pack_into("<Q", data, offset, count)
    file.write_bytes(data)
    message = refusal(read_scene, tmp_path)
    assert f"{stem}.bin: byte {offset + 8}" in message


def test_unterminated_image_name_is_refused(tmp_path: Path) -> None:
    file = write_scene(tmp_path, ColmapModel([PINHOLE], [ImageEntry("abcdefgh")])) / "sparse" / "0" / "images.bin"
    file.write_bytes(file.read_bytes().replace(b"\0" * 9, b"\1" * 9))  # the end of the name and the count after it
    assert "image name" in refusal(read_scene, tmp_path)


@pytest.mark.parametrize("kind", ["bin", "txt"])
@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_random_damage_raises_nothing_else(tmp_path_factory, kind: str, data: st.DataObject) -> None:
    path = write_scene(tmp_path_factory.mktemp("scene"), tiny_model(), kind)
    file = path / "sparse" / "0" / f"{data.draw(st.sampled_from(['cameras', 'images', 'points3D']))}.{kind}"
    content = bytearray(file.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    file.write_bytes(content)
    try:
        scene = read_scene(path)
    except DataError:
        return
    assert all(np.isfinite(view.world_to_camera).all() for view in scene.views)


# ---- sense


@pytest.mark.parametrize(
    "name", ["../a.jpg", "/etc/a.jpg", "x/../../a.jpg", "..\\a.jpg", "C:\\a.jpg", "", ".", "a\n.jpg"]
)
def test_name_outside_the_image_folder(tmp_path: Path, name: str) -> None:
    write_model(tmp_path / "sparse" / "0", replace(tiny_model(), images=[ImageEntry(name), ImageEntry("a.jpg")]))
    assert "not a path below" in refusal(read_scene, tmp_path)


@pytest.mark.parametrize(
    ("quaternion", "translation"),
    [
        ((math.nan, 0, 0, 0), (0, 0, 0)),
        ((math.inf, 0, 0, 0), (0, 0, 0)),
        ((1e308, 1e308, 1e308, 1e308), (0, 0, 0)),
        ((0, 0, 0, 0), (0, 0, 0)),
        ((1, 0, 0, 0), (0, math.nan, 0)),
        ((1, 0, 0, 0), (0, 0, -math.inf)),
        ((1, 0, 0, 0), (0, 1e300, 0)),  # the extent of the scene would be infinite
    ],
)
def test_invalid_pose_is_refused(tmp_path: Path, quaternion: tuple[float, ...], translation: tuple[float, ...]) -> None:
    images = [*tiny_model().images, ImageEntry("bad.jpg", 1, quaternion, translation)]
    assert "the pose of 'bad.jpg'" in refusal(read_scene, write_scene(tmp_path, replace(tiny_model(), images=images)))


@pytest.mark.parametrize(("kind", "width"), [("bin", 2**15 + 1), ("bin", 2**63), ("txt", 99999999999999999999)])
def test_camera_wider_than_any_image(tmp_path: Path, kind: str, width: int) -> None:
    camera = replace(PINHOLE, width=width)
    message = refusal(read_scene, write_scene(tmp_path, replace(tiny_model(), cameras=[camera]), kind))
    assert f"camera 1 is {width}x48" in message
    assert "at most 32768" in message


def test_tiny_focal_length_is_refused(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    camera = replace(PINHOLE, model="OPENCV_FISHEYE", params=(5e-324, 50.0, 32.0, 24.0, 0.1, 0.0, 0.0, 0.0))
    assert "focal lengths of at least 0.001" in refusal(
        read_scene, write_scene(tmp_path, replace(tiny_model(), cameras=[camera]))
    )
    assert not recwarn.list


def test_unknown_camera_is_refused(tmp_path: Path) -> None:
    images = [*tiny_model().images, ImageEntry("d.jpg", camera=7)]
    message = refusal(read_scene, write_scene(tmp_path, replace(tiny_model(), images=images)))
    assert "'d.jpg' has camera 7" in message


def test_nan_distortion_is_refused(tmp_path: Path) -> None:
    camera = CameraEntry(3, "OPENCV", 64, 48, (50, 50, 32, 24, math.nan, 0, 0, 0))
    message = refusal(read_scene, write_scene(tmp_path, ColmapModel([camera], [ImageEntry("a.jpg", 3)])))
    assert "finite numbers" in message


def test_distorted_camera_without_images_is_ignored(tmp_path: Path) -> None:
    fisheye = CameraEntry(9, "OPENCV_FISHEYE", 64, 48, (50, 50, 32, 24, 0.1, 0, 0, 0))
    scene = read_scene(write_scene(tmp_path, replace(tiny_model(), cameras=[PINHOLE, fisheye])))
    assert len(scene.views) == 3


@pytest.mark.parametrize(
    "camera",
    [
        replace(PINHOLE, width=0),
        replace(PINHOLE, height=0),
        replace(PINHOLE, params=(0.0, 51.0, 30.5, 25.25)),
        replace(PINHOLE, params=(50.0, -51.0, 30.5, 25.25)),
        replace(PINHOLE, params=(math.inf, 51.0, 30.5, 25.25)),
        replace(PINHOLE, params=(50.0, 51.0, math.nan, 25.25)),
    ],
)
def test_invalid_camera_is_refused(tmp_path: Path, camera: CameraEntry) -> None:
    assert "expected a positive size" in refusal(
        read_scene, write_scene(tmp_path, replace(tiny_model(), cameras=[camera]))
    )


@pytest.mark.parametrize("number", [-1, 18, 2**31 - 1])
def test_unknown_camera_model_is_refused(tmp_path: Path, number: int) -> None:
    file = write_scene(tmp_path, tiny_model()) / "sparse" / "0" / "cameras.bin"
    data = bytearray(file.read_bytes())
    struct.pack_into("<i", data, 12, number)
    file.write_bytes(data)
    assert f"unknown camera model '{number}'" in refusal(read_scene, tmp_path)


def test_missing_images_are_counted_and_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # names that are not cut
    write_scene(Path("s"), ColmapModel([PINHOLE], [ImageEntry(f"{i}.jpg") for i in range(9)]))
    for i in range(5):
        Path("s", "images", f"{i}.jpg").unlink()
    message = refusal(read_scene, Path("s"))
    assert "5 of 9" in message
    assert str(Path("s", "images", "0.jpg")) in message
    assert "4.jpg" not in message


def test_model_without_images_or_folder(tmp_path: Path) -> None:
    assert "no COLMAP model" in refusal(ColmapReader().read, tmp_path, 8)
    assert "no images" in refusal(read_scene, write_scene(tmp_path / "empty", replace(tiny_model(), images=[])))


def test_detect_lists_the_expected_files(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"looked for multi-camera video .* COLMAP .* Blender .* nerfstudio"):
        read_scene(tmp_path)
    with pytest.raises(DataError, match="no such folder"):
        read_scene(tmp_path / "none")
