"""New Gaussians from the depths that a model shows: where they lie, how many, and that the bits repeat."""

import json
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, Interrupted, NumericError
from clsplat.core.progress import Progress
from clsplat.gaussians.model import Model
from clsplat.methods.mini_splatting import ReinitFromDepth, sample_pixels
from clsplat.pipeline.loading import load
from clsplat.runs import opening, runner
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from clsplat.training import checkpoint
from clsplat.training.modules.base import learned_scene
from clsplat.training.modules.camera_optimizer import DEPTHS, TRANSLATIONS, CameraOptimizer, CameraState
from clsplat.training.run import Run
from tests.support.runs import digest, train

pytestmark = pytest.mark.slow

HEIGHT = 0.2  # of a plane, scene units
SPACING = 0.1
PIPELINE = """\
name: again
model: {sh_degree: 1}
stages:
  - init: {source: random, count: 500, opacity: 0.3}
  - optimize:
      steps: 4
      losses: [l1]
      during: [{raise_sh: {every: 2}}, {add_to_average: {every: 1}}, {checkpoint: {every: 1}}]
  - reinit_from_depth: {count: 301}
  - optimize: {steps: 4, losses: [l1], during: [{checkpoint: {every: 1}}]}
  - export
"""


def opened(scene: Path, means: np.ndarray, out: Path) -> Run:
    """A run that has read opaque Gaussians, as large as the spacing of a plane."""
    count = len(means)
    tables = {
        "means": means,
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(SPACING)) - [0, 0, 3],
        "logit_opacity": np.full((count, 1), 3.0),
        "sh_base": np.zeros((count, 3)),
        "sh_rest": np.zeros((count, 9)),
    }
    out.mkdir()
    Model(**{name: table.astype(np.float32) for name, table in tables.items()}).save(out.with_suffix(".ply"))
    stages = [{"init": {"source": "model", "file": str(out.with_suffix(".ply"))}}, "export"]
    out.with_suffix(".yaml").write_text(json.dumps({"name": "x", "model": {"sh_degree": 1}, "stages": stages}))
    checked = load(str(out.with_suffix(".yaml")), [f"scene.path='{scene}'"])
    run = opening.open_run(checked, out, None)
    checked.stages[0].act(run)
    return run


def plane() -> np.ndarray:
    across = np.arange(-2, 2, SPACING)
    return np.stack([*np.meshgrid(across, across), np.full(2 * [len(across)], HEIGHT)], axis=-1).reshape(-1, 3)


def test_they_lie_on_the_surface_that_is_seen(tiny_scene, tmp_path):
    """A plane, of which every photograph sees a part."""
    run = opened(tiny_scene, plane(), tmp_path / "run")
    before = run.model.gaussians.count
    run.metrics = {"test": {"1": {"psnr": 30.0}}}
    ReinitFromDepth(stage="reinit_from_depth", opacity=0.2, scale=0.5).act(run)
    assert not run.metrics, "which are of the model that it replaces"
    found = {name: run.model.gaussians.get(name) for name in run.model.gaussians.tables}
    assert len(found["means"]) == before
    assert np.median(np.abs(found["means"][:, 2] - HEIGHT)) < SPACING
    np.testing.assert_allclose(1 / (1 + np.exp(-found["logit_opacity"])), 0.2, rtol=1e-5)
    assert (found["log_scales"] == found["log_scales"][:, :1]).all(), "they are round"
    assert np.exp(found["log_scales"]).max() < 0.5, "and no larger than what they stand for"
    assert not found["sh_rest"].any()
    assert (run.adam, run.stats, run.model.degree) == (None, None, 1)


def test_its_colors_are_the_models_where_photographs_have_own(tiny_scene, tmp_path):
    gray = opened(tiny_scene, plane(), tmp_path / "model")
    stages = [
        {"init": {"source": "model", "file": str(tmp_path / "model.ply")}},
        {"optimize": {"steps": 2, "losses": ["l1"], "modules": ["exposure"], "update": "seen"}},
        {"reinit_from_depth": {"opacity": 0.2}},
        "export",
    ]
    (tmp_path / "x.yaml").write_text(json.dumps({"name": "x", "model": {"sh_degree": 1}, "stages": stages}))
    run = train(tiny_scene, tmp_path / "run", pipeline=str(tmp_path / "x.yaml"))
    ReinitFromDepth(stage="reinit_from_depth").act(gray)
    of_photographs, of_model = (np.median(np.abs(one.model.gaussians.get("sh_base"))) for one in (gray, run))
    assert of_model < 0.1 < 0.3 < of_photographs, "the model is gray"


def test_they_lie_where_the_cameras_were_learned_to_be(tiny_scene, tmp_path):
    """All cameras were learned to be a shift beside their places; the depths that they see are those of the model."""
    run, moved = opened(tiny_scene, plane(), tmp_path / "run"), opened(tiny_scene, plane(), tmp_path / "moved")
    poses = CameraState(CameraOptimizer(), moved.scene.split("train"), moved.original.views)
    poses.scalars |= {f"{DEPTHS}/{view.name}": 1.0 for view in poses.views}
    poses.scalars |= {f"{TRANSLATIONS}/{view.name}/z": 0.3 for view in poses.views}
    moved.modules = {"camera_optimizer": poses}
    expected = [view.position for view in learned_scene(moved).split("train")]
    assert np.abs(np.array(expected) - [view.position for view in run.scene.split("train")]).max() > 0.1
    for one in (run, moved):
        ReinitFromDepth(stage="reinit_from_depth").act(one)
    heights = moved.model.gaussians.get("means")[:, 2]
    assert np.median(np.abs(heights - HEIGHT)) < SPACING, "the plane stays where the model has it"
    assert not np.array_equal(moved.model.gaussians.get("means"), run.model.gaussians.get("means"))


def test_pixel_is_drawn_once_with_its_position_and_color(rng):
    view = View.looking_at([1, 2, 3], [0, 0.5, 0], [0, 0, 1], Camera(30, 20, 25.0, 27.0, 14.0, 11.0))
    alpha = np.where(np.arange(30) < 15, 0.9, 0.1) * (np.arange(20)[:, None] > 3)
    depth = rng.uniform(1, 5, (20, 30)).astype(np.float32)
    image = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    found = sample_pixels(view, alpha, depth, image, 200, np.random.default_rng(0))
    seen = found.positions @ view.world_to_camera[:, :3].T + view.world_to_camera[:, 3]
    at = seen[:, :2] / seen[:, 2:] * [25, 27] + [14, 11]
    columns, rows = np.floor(at).astype(int).T
    np.testing.assert_allclose(at - 0.5, np.stack([columns, rows], axis=1), atol=1e-9)
    np.testing.assert_allclose(seen[:, 2], depth[rows, columns])
    np.testing.assert_array_equal(found.colors, image[rows, columns] / 255)
    assert len(np.unique(rows * 30 + columns)) == 200
    assert rows.min() == 4
    assert (columns < 15).sum() > 5 * (columns >= 15).sum()
    np.testing.assert_allclose(found.pixel, depth[rows, columns] / np.sqrt(25 * 27))
    ratio = (found.spacing / found.pixel) ** -2  # the share of pixels that is drawn, more where more is covered
    np.testing.assert_allclose(ratio, np.minimum(1, 200 * alpha[rows, columns] / alpha.sum()))
    every = sample_pixels(view, alpha, depth, image, 9999, np.random.default_rng(0))
    assert len(every.positions) == 16 * 30


def test_a_model_that_covers_nothing_is_refused(tiny_scene, tmp_path):
    run = opened(tiny_scene, np.full((3, 3), 1e4), tmp_path / "run")
    with pytest.raises(NumericError, match="covers no pixel of the training images; train longer before"):
        ReinitFromDepth(stage="reinit_from_depth").act(run)
    assert run.model.gaussians.count == 3
    assert run.is_consistent, "so that it can be saved"


@pytest.fixture(scope="module")
def pipeline(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("pipeline") / "again.yaml"
    path.write_text(PIPELINE)
    return str(path)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, pipeline: str, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train(tiny_scene, tmp_path_factory.mktemp("runs") / "again", pipeline=pipeline)


def test_a_training_begins_anew_with_them(finished, tiny_scene, pipeline, tmp_path):
    (line,) = (one for one in map(json.loads, (finished.out / "metrics.jsonl").open()) if one["kind"] == "densify")
    assert (line["step"], line["before"], line["after"]) == (4, 500, 301)
    state, tables = checkpoint.load(checkpoint.saved(finished.out)[-1])
    assert set(state.updates.values()) == {4}
    assert {len(table) for table in tables.values()} == {301}
    assert not [name for name in tables if name.startswith("average")]
    assert digest(train(tiny_scene, tmp_path / "twice", pipeline=pipeline).out) == digest(finished.out)
    other = train(tiny_scene, tmp_path / "other", "seed=1", pipeline=pipeline)
    assert digest(other.out) != digest(finished.out)


@pytest.mark.parametrize("stop_at", [3, 4, 6])
def test_a_run_that_was_stopped_ends_with_the_same_bits(finished, tiny_scene, pipeline, tmp_path, stop_at):
    checked = load(pipeline, [f"scene.path='{tiny_scene}'", "stages.1.log_every=1", "stages.3.log_every=1"])
    run = opening.open_run(checked, tmp_path / "run", None)

    def stop(progress: Progress) -> None:
        run.interrupted = progress.step >= stop_at

    with pytest.raises(Interrupted):
        runner.execute(checked, run, "resume", stop)
    train(tiny_scene, run.out, pipeline=pipeline, resume=True)
    assert digest(run.out) == digest(finished.out)


def test_an_init_in_its_place_begins_anew_too(tiny_scene, tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(PIPELINE.replace("reinit_from_depth: {count: 301}", "init: {source: random, count: 700}"))
    run = train(tiny_scene, tmp_path / "run", pipeline=str(path))
    assert run.model.gaussians.count == 700
    assert set(run.adam.updates.values()) == {4}


def test_averages_end_with_it(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(PIPELINE.replace("  - export", "  - take_average"))
    with pytest.raises(ConfigError, match="take_average needs 'average'"):
        load(str(path))
