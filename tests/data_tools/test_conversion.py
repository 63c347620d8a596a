"""Tools for frames of videos and image pyramids."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from clsplat import cli
from clsplat.core.errors import DataError
from clsplat.data_tools import video as video_tool
from clsplat.data_tools.video import sharpest, write_frames
from clsplat.scene.images import read_image
from tests.support.pictures import contents
from tests.support.refusals import refusal

# ---- video


@pytest.fixture
def video(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Thirty frames with their number as gray level; only every third is sharp."""
    path = tmp_path / "v.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10, (96, 64))
    noise = rng.integers(0, 60, (64, 96, 1))
    for i in range(30):
        image = np.repeat(noise + 6 * i, 3, axis=2).astype(np.uint8)
        writer.write(image if i % 3 == 1 else cv2.GaussianBlur(image, (0, 0), 3))
    writer.release()
    return path


def test_sharp_frames_of_a_video(video, tmp_path):
    assert write_frames(video, tmp_path / "frames", frames=10) == 10
    files = sorted((tmp_path / "frames").glob("*.png"))
    assert [file.name for file in files] == [f"frame_{i:05d}.png" for i in range(1, 11)]
    levels = [(read_image(file).mean() - 29.5) / 6 for file in files]
    np.testing.assert_allclose(levels, np.arange(1, 30, 3), atol=0.6)


def test_still_camera_gives_one_frame(tmp_path, rng):
    """It is still, passes a wall in the middle third of the video, and is still again."""
    wall = cv2.GaussianBlur(rng.integers(0, 255, (90, 300, 3)).astype(np.uint8), (0, 0), 2)
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10, (120, 90))
    for i in range(60):
        place = 3 * int(np.clip(i - 20, 0, 20))
        writer.write(wall[:, place : place + 120])
    writer.release()
    write_frames(tmp_path / "v.avi", tmp_path / "frames", 8)
    chosen = json.loads((tmp_path / "frames" / ".frames.json").read_text())["chosen"]
    assert len(chosen) == 8
    assert sum(20 <= place <= 41 for place in chosen) >= 6


def test_parts_have_the_same_motion():
    assert sharpest([1, 3, 2, 1, 2, 3], [0] * 6, 3) == [1, 2, 5]
    assert sharpest([1, 1, 1, 1, 2, 1], [0, 0, 0, 0, 5, 5], 2) == [4, 5]
    assert sharpest([1.0], [0.0], 4) == [0]


def test_existing_frames_are_not_extracted_again(video, tmp_path):
    write_frames(video, tmp_path / "frames", frames=4, long_side=48)
    files = sorted((tmp_path / "frames").glob("*.png"))
    assert read_image(files[0]).shape == (32, 48, 3)
    kept = files[0].stat().st_mtime_ns
    files[1].unlink()
    assert write_frames(video, tmp_path / "frames", frames=4, long_side=48) == 4
    assert files[0].stat().st_mtime_ns == kept
    assert files[1].is_file()


@pytest.mark.parametrize("chosen", [5, [], [[1], 2], [True], [3, 1]])
def test_damaged_frame_list_is_rebuilt(chosen, video, tmp_path):
    write_frames(video, tmp_path / "frames", frames=4)
    record = tmp_path / "frames" / ".frames.json"
    before = record.read_text()
    record.write_text(json.dumps({**json.loads(before), "chosen": chosen}))
    (tmp_path / "frames" / "frame_00002.png").unlink()
    assert write_frames(video, tmp_path / "frames", frames=4) == 4
    assert record.read_text() == before
    assert (tmp_path / "frames" / "frame_00002.png").is_file()


def test_missing_frames_of_a_video_are_reported(video, tmp_path):
    write_frames(video, tmp_path / "frames", frames=2)
    record = tmp_path / "frames" / ".frames.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), "chosen": [0, 10**6]}))
    (tmp_path / "frames" / "frame_00002.png").unlink()
    with pytest.raises(DataError, match="lists frame 1000000, which is not in the video"):
        write_frames(video, tmp_path / "frames", frames=2)


def test_damaged_frame_is_extracted_again(video, tmp_path):
    write_frames(video, tmp_path / "frames", frames=2)
    frame = tmp_path / "frames" / "frame_00001.png"
    before = frame.read_bytes()
    frame.write_bytes(b"")
    assert write_frames(video, tmp_path / "frames", frames=2) == 2
    assert frame.read_bytes() == before


@pytest.mark.parametrize(
    "more", [{"frames": 5}, {"long_side": 32}, {"video": "w.avi"}], ids=lambda more: next(iter(more))
)
def test_frames_of_another_video_or_other_settings_do_not_mix(video, tmp_path, more):
    write_frames(video, tmp_path / "frames", frames=4)
    before = {path.name: path.read_bytes() for path in (tmp_path / "frames").iterdir()}
    (tmp_path / "w.avi").write_bytes(video.read_bytes() + b"more")
    asked = {"video": video, "frames": 4, "long_side": None, **more}
    message = refusal(write_frames, tmp_path / asked["video"], tmp_path / "frames", asked["frames"], asked["long_side"])
    assert f"contains frames that were extracted with another {next(iter(more))}; use another folder" in message
    assert {path.name: path.read_bytes() for path in (tmp_path / "frames").iterdir()} == before


def test_frames_do_not_mix_with_images_of_the_user(video, tmp_path):
    (tmp_path / "frames" / "below").mkdir(parents=True)
    (tmp_path / "frames" / "notes.txt").write_text("not an image")
    image = tmp_path / "frames" / "below" / "frame_00001.png"
    cv2.imwrite(str(image), np.zeros((4, 4, 3), np.uint8))
    kept = image.read_bytes()
    message = refusal(write_frames, video, tmp_path / "frames", 4)
    assert "contains 1 other images, such as frame_00001.png" in message
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == ["below", "notes.txt"]
    assert image.read_bytes() == kept


def test_extraction_resumes_after_a_kill(video, tmp_path, monkeypatch):
    write_frames(video, tmp_path / "whole", frames=6)
    written: list[str] = []
    write, looked = video_tool.write_image, video_tool._measure_frames

    def killed(path: Path, pixels: np.ndarray) -> None:
        if len(written) == 2:
            raise KeyboardInterrupt
        written.append(path.name)
        write(path, pixels)

    monkeypatch.setattr(video_tool, "write_image", killed)
    with pytest.raises(KeyboardInterrupt):
        write_frames(video, tmp_path / "frames", frames=6)
    monkeypatch.setattr(
        video_tool, "write_image", lambda path, pixels: (written.append(path.name), write(path, pixels))
    )
    monkeypatch.setattr(
        video_tool, "_measure_frames", lambda image: pytest.fail("was measured before") or looked(image)
    )
    assert write_frames(video, tmp_path / "frames", frames=6) == 6
    assert written == [f"frame_{i:05d}.png" for i in range(1, 7)]
    assert contents(tmp_path / "frames") == contents(tmp_path / "whole")


def test_files_that_are_not_videos_are_refused(tmp_path):
    (tmp_path / "v.mp4").write_text("nothing")
    assert "not a video that OpenCV decodes" in refusal(write_frames, tmp_path / "v.mp4", tmp_path / "out")
    assert "No such file" in refusal(write_frames, tmp_path / "w.mp4", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_image_is_refused_as_a_video(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((60, 80, 3), np.uint8))
    text = refusal(write_frames, tmp_path / "a.jpg", tmp_path / "out")
    assert text.startswith(f"{tmp_path / 'a.jpg'}: has only one frame")
    assert not list(tmp_path.glob("out/*.png"))


@pytest.mark.parametrize(("values", "parts", "chosen"), [([1, 3, 2], 9, [0, 1, 2]), ([2, 2, 1, 5], 2, [0, 3])])
def test_sharpest_frame_of_each_segment_is_chosen(values, parts, chosen):
    assert sharpest(values, [0.0] * len(values), parts) == chosen


# ---- on the command line


def test_data_tools_are_commands():
    listing = CliRunner().invoke(cli.app, ["data", "--help"]).output
    for name in ("photos", "video", "undistort", "cameras", "synthetic", "fetch"):
        assert name in listing
