"""A time-lapse during training: the model's bits do not change, and killed runs resume to the same images."""

import shutil

import pytest

from clsplat.core.errors import ConfigError
from clsplat.pipeline.loading import load
from clsplat.scene.images import read_image, read_image_size
from clsplat.viewer.video.encoding import count_frames
from tests.support.commands import clsplat as command
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow
SNAPSHOT = "        - snapshot: {every: 2, view: test/r_001}\n"


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory):
    """smoke, with a time-lapse and a video."""
    text = load("smoke").path.read_text()
    text = text.replace("        - checkpoint: {every: 10}\n", f"        - checkpoint: {{every: 10}}\n{SNAPSHOT}")
    text += "  - timelapse: {fps: 4}\n  - video: {path: orbit, frames: 5, size: 32x48}\n"
    text += "  - cameras: {formats: [inria, colmap]}\n"
    file = tmp_path_factory.mktemp("pipelines") / "lapse.yaml"
    file.write_text(text)
    return file


@pytest.fixture(scope="module")
def run(pipeline, tiny_scene, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "lapse"
    train(tiny_scene, out, *FEW, pipeline=str(pipeline))
    return out


def contents(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_images_and_videos_change_no_bits_of_the_model(run, few_steps):
    assert digest(run) == digest(few_steps)


def test_images_are_written_periodically_and_joined_to_a_video(run):
    names = [path.name for path in sorted((run / "timelapse").iterdir())]
    assert names == [f"step_{step:06d}.png" for step in range(2, 13, 2)]
    assert {read_image_size(path) for path in (run / "timelapse").iterdir()} == {(40, 40)}
    assert count_frames(run / "timelapse.webm") == 6
    assert count_frames(run / "video.webm") == 5
    last, render = (read_image(run / name) for name in ("timelapse/step_000012.png", "renders/test/r_001.png"))
    assert (last == render).all(), "the camera of the view, the model of the last step"


def test_cameras_are_written_next_to_the_model(run):
    assert (run / "cameras" / "cameras.json").is_file()
    assert (run / "cameras" / "sparse" / "0" / "images.bin").is_file()


def test_run_with_videos_passes_the_check(run):
    assert "all" in command("check", run).stdout


def test_killed_run_resumes_to_the_same_images(run, pipeline, tiny_scene, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(run, out)
    (out / "checkpoints" / "step_000012.npz").unlink()  # back to step 8
    for name in ("point_cloud.ply", "metrics.json", "checksums.json", "timelapse.webm", "timelapse/step_000012.png"):
        (out / name).unlink()
    (out / "timelapse" / "step_000999.png").write_bytes(b"of another run")
    train(tiny_scene, out, *FEW, pipeline=str(pipeline), resume=True)
    (out / "timelapse" / "step_000999.png").unlink()
    assert contents(out / "timelapse") == contents(run / "timelapse")
    assert (out / "timelapse.webm").read_bytes() == (run / "timelapse.webm").read_bytes()
    assert digest(out) == digest(run)


def test_time_lapse_needs_images(pipeline, tmp_path):
    text = pipeline.read_text()
    (tmp_path / "none.yaml").write_text(text.replace(SNAPSHOT, ""))
    with pytest.raises(ConfigError, match=r"timelapse needs 'snapshots', which no earlier stage creates; add snapshot"):
        load(str(tmp_path / "none.yaml"))
    with pytest.raises(ConfigError, match="timelapse needs 'snapshots'"):  # training ends before the first
        load(str(pipeline), ["optimize.steps=1"])


@pytest.mark.parametrize(
    ("change", "message"),
    {
        "snapshot.size=31x40": "even numbers",
        "timelapse.fps=0": "at least 1",
        "video.size=1x1": "even numbers",
        "video.frames=0": "greater than 0",
        "video.file=video.gif": "does not end in .webm, .mp4",
        "snapshot.folder=../elsewhere": "inside the run folder",
    }.items(),
)
def test_bad_settings_are_refused_before_the_run(change, message, pipeline):
    with pytest.raises(ConfigError, match=message):
        load(str(pipeline), [change])


def test_missing_view_and_imageless_folder_are_reported(pipeline, tiny_scene, tmp_path):
    with pytest.raises(ConfigError, match=r"the scene has no view 'test/r_1'; did you mean 'test/r_001'"):
        train(tiny_scene, tmp_path / "a", *FEW, "snapshot.view='test/r_1'", pipeline=str(pipeline))
    with pytest.raises(ConfigError, match="'pictures' has no snapshots"):
        train(tiny_scene, tmp_path / "b", *FEW, "timelapse.folder=pictures", pipeline=str(pipeline))
