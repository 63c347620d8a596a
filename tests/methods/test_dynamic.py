"""Training of moving scenes: the recipe in few steps, its outputs, and its refusals."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.api.renderer import Renderer
from clsplat.core.errors import ConfigError, DataError
from clsplat.data_tools.synthetic import write_dataset
from clsplat.formats.splats import MOTION
from clsplat.gaussians.model import load
from clsplat.gaussians.structs import moment_tables
from clsplat.stages.init_motion import add_motion, estimate_motion
from clsplat.training import checkpoint
from clsplat.training.memory import plan, table_widths
from tests.support.moving_scene import Moving
from tests.support.recipes import ONE_THREAD, STEPS, digest, short, train
from tests.support.runs import train as train_overridden

pytestmark = pytest.mark.slow

SMALL = Moving(size=24, train=2, test=1, times=6)
ALONE = """
import sys
from pathlib import Path
from tests.support.recipes import short, train
train(short("dynamic_7k", Path(sys.argv[1])), Path(sys.argv[2]))
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("moving") / "scene"
    write_dataset(out, SMALL, workers=1)
    return out


@pytest.fixture(scope="module")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    train(short("dynamic_7k", scene), out)
    return out


def test_resumed_run_has_the_same_bits(finished, scene, tmp_path):
    stopped = tmp_path / "stopped"
    shutil.copytree(finished, stopped)
    *_, last = sorted((stopped / "checkpoints").iterdir())
    last.unlink()
    for file in ("point_cloud.ply", "metrics.json", "checksums.json", "status.json"):
        (stopped / file).unlink()
    assert list((stopped / "checkpoints").iterdir())
    assert train(short("dynamic_7k", scene), stopped, resume=True) == digest(finished)


def test_single_threaded_run_has_the_same_bits(finished, scene, tmp_path):
    command = [sys.executable, "-c", ALONE, scene, tmp_path / "alone"]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2], env={**os.environ, **ONE_THREAD}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert digest(tmp_path / "alone") == digest(finished)


def test_motion_and_its_adam_moments_are_trained_and_saved(finished):
    state, tables = checkpoint.load(checkpoint.list_files(finished)[-1])
    motion = tables[f"gaussians/{MOTION}"]
    assert state.updates[MOTION] > STEPS / 2
    assert np.abs(motion[:, :3]).max() > 0
    assert all(np.abs(tables[name]).max() > 0 for name in moment_tables(MOTION))
    np.testing.assert_array_equal(load(finished).motion, motion)


def test_renderer_uses_the_time_of_the_view(finished, scene):
    model, view = load(finished), clsplat.read_scene(scene).split("test")[0]
    renderer = Renderer(model)
    pictures = {time: renderer.render(replace(view, time=time)) for time in (0.0, 1.0)}
    for time, picture in pictures.items():
        static = Renderer(model.at(time), renderer.device).render(view)
        np.testing.assert_allclose(picture.image, static.image, atol=5e-3)
        np.testing.assert_allclose(picture.image.mean(), static.image.mean(), atol=1e-4)
    gradients = pictures[0.0].backward(image=np.ones_like(pictures[0.0].image))
    assert gradients.motion.shape == model.motion.shape
    assert np.abs(gradients.motion).max() > 0


def test_view_without_a_time_shows_time_0_with_a_warning(finished, scene, caplog):
    from clsplat.render import motion

    motion._warn_about_first_timestamp.cache_clear()
    model, view = load(finished), clsplat.read_scene(scene).split("test")[0]
    renderer = Renderer(model)
    actual = [renderer.render(replace(view, time=time)).image for time in (None, 0.0, None)]
    np.testing.assert_array_equal(actual[0], actual[1])
    assert [record.message for record in caplog.records].count(caplog.records[-1].message) == 1
    assert "first timestamp" in caplog.text


def test_static_scene_is_refused(tiny_scene, tmp_path):
    with pytest.raises(DataError, match=r"its views have no timestamps, which `model\.time`"):
        train_overridden(tiny_scene, tmp_path / "run", pipeline="dynamic_7k")


def test_static_recipe_trains_on_a_moving_scene(scene, tmp_path):
    train_overridden(scene, tmp_path / "run", "optimize.steps=3", "init.source='points'")
    assert load(tmp_path / "run").motion is None


def test_moving_model_initializes_only_the_same_motion(finished, scene, tmp_path):
    start = ("init.source='model'", f"init.file='{finished}'", "optimize.steps=2")
    bound = "optimize.rates={motion: {min_duration: 0.9}}"
    run = train_overridden(scene, tmp_path / "again", *start, "model.time={degree: 1}", bound)
    assert run.model.gaussians.tables[MOTION].components == 5
    durations = [np.exp(table[:, 4].min()) for table in (load(finished).motion, run.model.gaussians.get(MOTION))]
    assert durations[0] < 0.5
    assert durations[1] == pytest.approx(0.9)
    with pytest.raises(ConfigError, match="another degree"):
        train_overridden(scene, tmp_path / "other", *start, "model.time={degree: 2}")
    with pytest.raises(ConfigError, match=r"no `model\.time`"):
        train_overridden(scene, tmp_path / "static", *start)


def test_memory_plan_includes_motion(info):
    static, moves = table_widths(1), table_widths(1, 5)
    more = plan(info, moves, 0, 100).gaussian - plan(info, static, 0, 100).gaussian
    assert more == 4 * (3 * 5 + 5 + 3 + 4 + 1)  # table and moments, gradient, means, quaternions and logits


def test_points_without_a_time_start_at_rest(rng):
    times = rng.uniform(0, 1, 400)
    positions = rng.normal(0, 0.1, (400, 3))
    positions[200:] += np.array([10, 0, 0]) + 40 * times[200:, None]
    spread, velocities = estimate_motion(positions, times)
    assert (spread[:200] > 0.2).mean() > 0.95
    assert (spread[200:] < 0.1).mean() > 0.95
    assert np.median(np.abs(velocities[200:] - 40)) < 4
    parameters = {"means": positions.astype(np.float32)}
    motion = add_motion(parameters, load_settings(), times, (4.0, 0.1), 0)[MOTION]
    np.testing.assert_allclose(motion[:, 3], times, rtol=1e-6)
    assert (np.exp(motion[:200, 4]) > 3.9).mean() > 0.95
    assert (np.exp(motion[200:, 4]) < 0.2).mean() > 0.95
    np.testing.assert_allclose(motion[spread < 0.18, :3], velocities[spread < 0.18], rtol=1e-4)
    assert not motion[spread > 0.18, :3].any()
    drawn = add_motion(parameters, load_settings(), None, (4.0, 0.1), 0)[MOTION]
    assert np.ptp(drawn[:, 3]) > 0.9
    np.testing.assert_allclose(np.exp(drawn[:, 4]), 4, rtol=1e-5)


def load_settings():
    from clsplat.render.filters import Motion

    return Motion()
