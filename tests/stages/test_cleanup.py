"""The stage `cleanup`: the effect of each rule, refusals, and repeated bits."""

import json
from pathlib import Path

import numpy as np
import pytest

from clsplat.core.errors import ConfigError, Interrupted, NumericError
from clsplat.core.progress import Progress
from clsplat.density.outliers import PruneFar, PruneWide
from clsplat.gaussians.model import Model
from clsplat.methods.adc import PruneFaint
from clsplat.methods.micro_splatting import MergeNeighbors
from clsplat.methods.mini_splatting import PruneUseless
from clsplat.pipeline.loading import load
from clsplat.runs import opening, runner
from clsplat.scene.detect import read_scene
from clsplat.stages.cleanup import Cleanup
from clsplat.training import checkpoint
from clsplat.training.run import Run
from tests.support.runs import train

pytestmark = pytest.mark.slow

FAINT, FAR, USELESS, WIDE = 27, 28, 29, 30  # rows of those that are to go, behind the others
RULES = {
    FAINT: PruneFaint(opacity_below=0.02),
    FAR: PruneFar(),
    USELESS: PruneUseless(views_below=0),
    WIDE: PruneWide(),
}
ENDING = """\
name: ending
model: {sh_degree: 0}
stages:
  - init: {source: random, count: 600, opacity: 0.3}
  - optimize: {steps: 4, losses: [l1], during: [{average: {every: 1}}, {checkpoint: {every: 1}}]}
  - cleanup:
      rules: [{type: prune_faint, opacity_below: 0.29}, {type: prune_useless, views_below: 2, weight_total: 0.95}]
  - optimize: {steps: 4, losses: [l1], during: [{checkpoint: {every: 1}}]}
  - export
"""


@pytest.fixture(scope="module")
def flawed_model(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """27 Gaussians in a cube, and four more that should not be: faint, far, out of sight, wide before a camera."""
    scene = read_scene(tiny_scene)
    view = scene.split("train")[0]
    forward, camera = view.world_to_camera[2, :3], view.position
    grid = np.stack(np.meshgrid(*3 * [np.linspace(-0.4, 0.4, 3)]), axis=-1).reshape(-1, 3)
    middle = camera - (camera @ forward) * forward  # what the camera looks at, nearly
    means = np.concatenate([grid, [[0, 0, 0], middle + 900 * forward, camera - 3 * forward, camera + 0.6 * forward]])
    sizes = np.full(len(means), 0.1)
    sizes[[FAINT, FAR, WIDE]] = 0.5, 30.0, 0.5
    opacity = np.full((len(means), 1), 0.8)
    opacity[[FAINT, WIDE], 0] = 0.015, 0.3
    tables = {
        "means": means,
        "quats": np.tile([1.0, 0, 0, 0], (len(means), 1)),
        "log_scales": np.log(sizes)[:, None].repeat(3, axis=1),
        "logit_opacity": np.log(opacity / (1 - opacity)),
        "sh_base": np.zeros((len(means), 3)),
        "sh_rest": np.zeros((len(means), 0)),
    }
    file = tmp_path_factory.mktemp("model") / "spoilt.ply"
    Model(**{name: table.astype(np.float32) for name, table in tables.items()}).save(file)
    return file


def opened(scene: Path, model: Path, out: Path) -> Run:
    """A run that has read a model, and no more."""
    out.mkdir()
    path = out.with_suffix(".yaml")
    stages = [{"init": {"source": "model", "file": str(model)}}, "cleanup", "export"]
    path.write_text(json.dumps({"name": "spoilt", "model": {"sh_degree": 0}, "stages": stages}))
    checked = load(str(path), [f"scene.path='{scene}'"])
    run = opening.open_run(checked, out, None)
    checked.stages[0].act(run)
    return run


@pytest.mark.parametrize("row", RULES)
def test_each_rule_removes_its_target(tiny_scene, flawed_model, tmp_path, row):
    run = opened(tiny_scene, flawed_model, tmp_path / "run")
    before = run.model.gaussians.get("means")
    Cleanup(stage="cleanup", rules=[RULES[row]]).act(run)
    np.testing.assert_array_equal(run.model.gaussians.get("means"), np.delete(before, row, axis=0))


def test_all_rules_remove_and_report_their_targets(tiny_scene, flawed_model, tmp_path, caplog):
    run, caplog.handler.level = opened(tiny_scene, flawed_model, tmp_path / "run"), 0
    before = {name: run.model.gaussians.get(name) for name in run.model.gaussians.trained}
    with caplog.at_level("INFO", logger="clsplat"):
        Cleanup(stage="cleanup", rules=list(RULES.values())).act(run)
    for name, table in before.items():
        np.testing.assert_array_equal(run.model.gaussians.get(name), table[:FAINT], err_msg=name)
    causes = dict.fromkeys(("prune_faint", "prune_far", "prune_useless", "prune_wide"), 1)
    assert "27 of 31 Gaussians kept; removed: " + ", ".join(f"{name} 1" for name in causes) in caplog.text
    run.records.write()
    (line,) = (json.loads(line) for line in (run.out / "metrics.jsonl").read_text().splitlines())
    assert (line["kind"], line["before"], line["after"], line["causes"]) == ("densify", 31, 27, causes)


def test_large_screen_size_is_kept_by_default():
    assert Cleanup(stage="cleanup").rules == [RULES[row] for row in (FAINT, FAR, USELESS)]


def test_one_view_suffices_by_default(tiny_scene, flawed_model, tmp_path):
    run = opened(tiny_scene, flawed_model, tmp_path / "run")
    Cleanup(stage="cleanup", rules=[PruneUseless(views_below=2)]).act(run)
    assert run.model.gaussians.count < 30, "others than the one out of sight"


def test_removing_every_gaussian_is_refused(tiny_scene, flawed_model, tmp_path):
    run = opened(tiny_scene, flawed_model, tmp_path / "run")
    before = run.model.gaussians.get("means")
    with pytest.raises(NumericError, match="cleanup: its rules would remove all Gaussians; weaken them"):
        Cleanup(stage="cleanup", rules=[PruneFaint(opacity_below=0.9)]).act(run)
    np.testing.assert_array_equal(run.model.gaussians.get("means"), before)
    assert run.is_consistent


def test_undeclared_rewriting_rule_does_not_change_the_model(tiny_scene, flawed_model, tmp_path, monkeypatch):
    monkeypatch.setattr(MergeNeighbors, "rewrites", False)
    run = opened(tiny_scene, flawed_model, tmp_path / "run")
    before = {name: run.model.gaussians.get(name) for name in ("means", "log_scales", "logit_opacity")}
    with pytest.raises(ConfigError, match=r"a rule changes .* of Gaussians that it does not remove; use it in densify"):
        Cleanup(stage="cleanup", rules=[MergeNeighbors()]).act(run)
    for name, table in before.items():
        np.testing.assert_array_equal(run.model.gaussians.get(name), table)
    assert run.is_consistent


@pytest.fixture(scope="module")
def ending(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("pipeline") / "ending.yaml"
    path.write_text(ENDING)
    return str(path)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, ending: str, tmp_path_factory: pytest.TempPathFactory) -> Run:
    return train(tiny_scene, tmp_path_factory.mktemp("runs") / "ending", pipeline=ending)


def test_training_continues_after_a_cleanup(finished):
    (line,) = (one for one in map(json.loads, (finished.out / "metrics.jsonl").open()) if one["kind"] == "densify")
    assert line["step"] == 4
    assert min(line["causes"].values()) > 0
    assert 0 < line["after"] == 600 - sum(line["causes"].values()) == finished.model.gaussians.count
    _, tables = checkpoint.load(checkpoint.list_files(finished.out)[-1])
    assert {len(table) for table in tables.values()} == {line["after"]}


@pytest.mark.parametrize("stop_at", [4, 6])
def test_resumed_run_has_the_same_bits(finished, tiny_scene, ending, tmp_path, stop_at):
    checked = load(ending, [f"scene.path='{tiny_scene}'", *("stages.1.log_every=1", "stages.3.log_every=1")])
    run = opening.open_run(checked, tmp_path / "run", None)

    def stop(progress: Progress) -> None:
        run.interrupted = progress.step >= stop_at

    with pytest.raises(Interrupted):
        runner.execute(checked, run, "resume", stop)
    train(tiny_scene, run.out, pipeline=ending, resume=True)
    assert (run.out / "point_cloud.ply").read_bytes() == (finished.out / "point_cloud.ply").read_bytes()


def test_refused_cleanup_saves_the_trained_state(finished, tiny_scene, tmp_path, caplog):
    out, path = tmp_path / "run", tmp_path / "ending.yaml"
    path.write_text(ENDING.replace(", {checkpoint: {every: 1}}", "").replace("{checkpoint: {every: 1}}", ""))
    with pytest.raises(NumericError, match="would remove all Gaussians"):
        train(tiny_scene, out, "cleanup.rules.0.opacity_below=1", pipeline=str(path))
    assert "the state of step 4 is saved in" in caplog.text
    assert [path.name for path in checkpoint.list_files(out)] == ["step_000004.npz"]
    train(tiny_scene, out, pipeline=str(path), resume=True)
    assert (out / "point_cloud.ply").read_bytes() == (finished.out / "point_cloud.ply").read_bytes()


@pytest.mark.parametrize(
    ("rules", "complaint"),
    [
        ("[]", "expected a list of at least 1"),
        ("[clone]", "the rule 'clone' grows; expected rules that remove"),
        ("[merge_neighbors]", "the rule 'merge_neighbors' changes the Gaussians that it keeps; use it in densify"),
        (
            "[{type: prune_faint, start: 9}]",
            "the rule 'prune_faint' has a 'start', but cleanup applies it once; remove",
        ),
        ("[{type: prune_scored}]", "the rule 'prune_scored' reads screen_grad from training; use it in densify"),
    ],
)
def test_rules_that_do_more_than_remove_are_refused(tmp_path, rules, complaint):
    path = tmp_path / "x.yaml"
    path.write_text(f"name: x\nstages:\n  - init\n  - cleanup: {{rules: {rules}}}\n")
    with pytest.raises(ConfigError, match=complaint):
        load(str(path))
