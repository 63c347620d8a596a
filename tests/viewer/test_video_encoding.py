"""Video files: contents, reproducible bytes, and no partial files."""

import builtins
import sys

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, OutputError
from clsplat.viewer.video import encoding
from clsplat.viewer.video import encoding as webm
from tests.support.pictures import decoded

SUFFIXES = [".webm", pytest.param(".mp4", marks=pytest.mark.skipif("not _has_av()", reason="PyAV is missing"))]


def _has_av() -> bool:
    try:
        import av  # noqa: F401
    except ImportError:
        return False
    return True


def pictures(count=9, size=(64, 48)):
    """A bright square that wanders over a smooth ground."""
    width, height = size
    ground = np.zeros((height, width, 3), np.uint8)
    ground[..., 0], ground[..., 2] = np.linspace(40, 200, width), np.linspace(60, 180, height)[:, None]
    results = []
    for i in range(count):
        image = ground.copy()
        image[10:26, 4 + 3 * i : 20 + 3 * i] = (240, 200, 30)
        results.append(image)
    return results


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_video_contains_its_frames(suffix, tmp_path):
    assert clsplat.write_video(tmp_path / f"a{suffix}", pictures(), fps=12) == 9
    actual, fps = decoded(tmp_path / f"a{suffix}")
    assert (len(actual), fps) == (9, 12)
    for old, new in zip(pictures(), actual, strict=True):
        assert clsplat.metrics.psnr(new, old) > 26, "colors are in their order and their range"
    assert [path.name for path in tmp_path.iterdir()] == [f"a{suffix}"]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_equal_frames_give_equal_bytes(suffix, tmp_path):
    for name in "ab":
        clsplat.write_video(tmp_path / f"{name}{suffix}", [image / np.float32(255) for image in pictures()], 30)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


def test_encoder_is_silent(tmp_path, capfd):
    clsplat.write_video(tmp_path / "a.webm", pictures())
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_failure_leaves_the_previous_file(suffix, tmp_path):
    file = tmp_path / f"a{suffix}"
    file.write_bytes(b"old")
    with pytest.raises(ValueError, match="image 1 has shape"):
        clsplat.write_video(file, [pictures()[0], pictures(1, (32, 48))[0]])
    with pytest.raises(ValueError, match="at least one image"):
        clsplat.write_video(file, [])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {file.name: b"old"}


def test_file_with_missing_frames_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(encoding, "count_frames", lambda path: 3)
    with pytest.raises(OutputError, match="3 of 9 frames can be read back"):
        clsplat.write_video(tmp_path / "a.webm", pictures())
    assert not list(tmp_path.iterdir())


def test_uncreatable_folder_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        clsplat.write_video(tmp_path / "file" / "a.webm", pictures())


def test_mp4_without_pyav_names_the_package(tmp_path, monkeypatch):
    load = builtins.__import__

    def refuse(name, *rest, **more):
        if name == "av":
            raise ImportError(name)
        return load(name, *rest, **more)

    monkeypatch.delitem(sys.modules, "av", raising=False)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ConfigError, match=r"pip install '\.\[video\]'`, or use the suffix .webm"):
        clsplat.write_video(tmp_path / "a.mp4", pictures())


def test_opencv_without_an_encoder_names_alternatives(tmp_path, monkeypatch):
    monkeypatch.setattr(encoding, "CODEC", "none")
    with pytest.raises(OutputError, match=r"cannot write WebM.*or write images with --out DIR"):
        clsplat.write_video(tmp_path / "a.webm", pictures())


@pytest.mark.parametrize("name", ["a.avi", "a", "a.gif"])
def test_other_suffixes_are_refused(name, tmp_path):
    with pytest.raises(ConfigError, match=r"ends in \.webm or \.mp4"):
        clsplat.write_video(tmp_path / name, pictures())


def test_odd_sizes_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="even numbers"):
        clsplat.write_video(tmp_path / "a.webm", pictures(2, (63, 48)))


def test_file_that_is_not_webm_is_unchanged(tmp_path, rng):
    for length in (0, 1, 2, 7, 300):
        data = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
        (tmp_path / "x").write_bytes(data)
        webm.fix_track_ids(tmp_path / "x")
        assert len((tmp_path / "x").read_bytes()) == length
