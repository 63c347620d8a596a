"""Settings of a run that may change when it goes on, and those that may not."""

import json
import shutil
from pathlib import Path

import pytest

from clsplat.errors import ConfigError
from clsplat.training import archive
from tests.test_checkpoints import FEW, crafted, model, steps_saved
from tests.test_training import train

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "few"
    train(tiny_scene, out, *FEW)
    return out


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    """The run as it was killed after step 8 and its checkpoints."""
    shutil.copytree(finished, tmp_path / "run")
    (tmp_path / "run" / "checkpoints" / "step_000012.npz").unlink()
    for name in ("point_cloud.ply", "metrics.json", "checksums.json"):
        (tmp_path / "run" / name).unlink()
    return tmp_path / "run"


def test_what_no_table_depends_on_may_change(copy, tiny_scene, finished, caplog):
    train(tiny_scene, copy, *FEW, "checkpoint.keep=1", "optimize.log_every=4", "render.folder=other", resume=True)
    assert model(copy) == model(finished)
    assert "bits are not" not in caplog.text
    assert "changes" not in json.loads((copy / "metrics.json").read_text())
    assert steps_saved(copy) == ["step_000012.npz"]


@pytest.mark.parametrize("change", ["optimize.steps=14", "densify.stop=6", "optimize.losses.0.weight=0.7"])
def test_numbers_of_the_training_may_change(change, copy, tiny_scene, finished):
    run = train(tiny_scene, copy, *FEW, change, resume=True)
    assert run.step == (14 if "steps" in change else 12)
    assert len(json.loads((copy / "metrics.json").read_text())["changes"]) == 1
    assert f"{change.split('=')[1]}" in (copy / "pipeline.yaml").read_text()


@pytest.mark.parametrize("change", ["seed=3", "init.count=70", "model.sh_degree=2", "optimize.losses=[l1]"])
def test_what_tables_depend_on_may_not_change(change, copy, tiny_scene):
    with pytest.raises(ConfigError, match=r"was made with other settings: .*those settings, or --restart"):
        train(tiny_scene, copy, *FEW, change, resume=True)


def test_a_run_that_has_trained_for_longer_is_refused(copy, tiny_scene):
    before = (copy / "pipeline.yaml").read_text()
    with pytest.raises(ConfigError, match=r"already at step 8; optimize.steps=6 would end before it"):
        train(tiny_scene, copy, *FEW, "optimize.steps=6", resume=True)
    assert (copy / "pipeline.yaml").read_text() == before


def test_a_stage_that_is_over_keeps_its_settings(copy, tiny_scene):
    crafted(copy / "checkpoints" / "step_000008.npz", lambda notes, arrays: notes.update(cursor=2, stage_step=0))
    with pytest.raises(ConfigError, match="was saved after that stage, at step 8"):
        train(tiny_scene, copy, *FEW, "optimize.steps=20", resume=True)


def test_a_run_that_stopped_after_its_last_stage_ends(copy, tiny_scene, finished):
    last = len(archive.read(copy / "checkpoints" / "step_000008.npz")[0]["pipeline"]["stages"])
    shutil.copy(finished / "checkpoints" / "step_000012.npz", copy / "checkpoints")
    written = {"point_cloud.ply": model(finished)}
    crafted(
        copy / "checkpoints" / "step_000012.npz",
        lambda notes, arrays: notes.update(cursor=last, stage_step=0, written=written),
    )
    shutil.copy(finished / "point_cloud.ply", copy)
    before = (copy / "checkpoints" / "step_000012.npz").read_bytes()
    assert train(tiny_scene, copy, *FEW, resume=True).step == 12
    assert json.loads((copy / "status.json").read_text())["state"] == "done"
    assert (copy / "checkpoints" / "step_000012.npz").read_bytes() == before
