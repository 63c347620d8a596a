"""A non-finite state is never a checkpoint, and the advice in the message works."""

import json
import re
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.core.errors import NumericError
from clsplat.density.statistics import SplatStats
from clsplat.training.checkpoint import suggest_rate
from clsplat.training.run import Run
from tests.support.runs import FEW, digest, steps_saved, train

pytestmark = pytest.mark.slow


def break_at(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the means non-finite in a step."""
    train_one = Run.editing_tables
    run_step = {}

    def editing_tables(run: Run):
        run_step["run"] = run
        return train_one(run)

    monkeypatch.setattr(Run, "editing_tables", editing_tables)
    add = SplatStats.add

    def add_and_break(stats, *arguments):
        add(stats, *arguments)
        if run_step["run"].step == step:
            stats.gaussians["means"].fill(np.nan)

    monkeypatch.setattr(SplatStats, "add", add_and_break)


@pytest.mark.parametrize(
    ("step", "log_every"), [(6, 5), (8, 100), (7, 1)], ids=["between", "at a checkpoint", "at once"]
)
def test_nonfinite_state_is_never_a_checkpoint(step, log_every, tiny_scene, tmp_path, monkeypatch, few_steps):
    out, settings = tmp_path / "run", (*FEW, f"optimize.log_every={log_every}")
    break_at(step, monkeypatch)
    with pytest.raises(NumericError, match=r"not finite: means.*the state is in .*failed_0000\d\d.npz") as error:
        train(tiny_scene, out, *settings)
    assert len(steps_saved(out)) == 2
    assert steps_saved(out)[0].startswith("failed_")
    assert steps_saved(out)[1] == "step_000004.npz"
    command = re.search(r"`clsplat resume (\S+) --set (\S+)` .*resume from step_000004.npz", str(error.value))
    assert command
    with pytest.raises(NumericError):  # and again, however often
        train(tiny_scene, out, *settings, resume=True)
    assert steps_saved(out)[1] == "step_000004.npz"
    monkeypatch.undo()
    train(tiny_scene, out, *settings, resume=True)
    assert digest(out) == digest(few_steps)


def test_nonfinite_loss_leaves_no_newer_checkpoint(tiny_scene, tmp_path, monkeypatch):
    numbers = SimpleNamespace(isfinite=lambda value: False)
    monkeypatch.setattr("clsplat.training.checkpoint.math", numbers)
    with pytest.raises(NumericError, match=r"parameters not finite: none; .*resume from step_000004.npz"):
        train(tiny_scene, tmp_path, *FEW)
    assert steps_saved(tmp_path) == ["failed_000005.npz", "step_000004.npz"]


def test_advice_after_a_nonfinite_state_works(tiny_scene, tmp_path, caplog):
    settings = (*FEW, "optimize.rates.sh_base=[[4, 0.01], [5, 1e38]]")
    with pytest.raises(NumericError) as error:
        train(tiny_scene, tmp_path, *settings)
    advice = re.search(r"`clsplat resume \S+ --set (optimize.rates.sh_base=\S+)`", str(error.value))
    assert advice, str(error.value)
    train(tiny_scene, tmp_path, *settings, advice[1], resume=True)
    assert "step 4: stages[1].optimize.rates.sh_base was " in caplog.text
    assert "from here on, results differ from those without this change" in caplog.text
    changes = json.loads((tmp_path / "metrics.json").read_text())["changes"]
    assert len(changes) == 1
    assert changes[0].startswith("step 4: stages[1].optimize.rates.sh_base was ")
    train(tiny_scene, tmp_path, *settings, advice[1], resume=True)
    assert json.loads((tmp_path / "metrics.json").read_text())["changes"] == changes, "they stay with the run"


def test_advice_names_the_training_stage(tiny_scene, tmp_path, few_steps):
    run = train(tiny_scene, tmp_path, *FEW)
    assert suggest_rate(run, ["quats"]) == "optimize.rates.quats=0.0005"
    stages = run.pipeline["stages"]
    run.pipeline = {**run.pipeline, "stages": [*stages[:2], *stages[1:]]}
    assert suggest_rate(run, []).startswith("stages.2.rates.")
    run.stage_index = 1
    assert suggest_rate(run, ["sh_rest"]) == "stages.1.rates.sh_rest=5e-05"
    run.pipeline = {**run.pipeline, "stages": [stages[0], stages[-1]]}
    assert suggest_rate(run, ["means"]) == "optimize.rates.means=1.6e-05"
    assert suggest_rate(run, ["motion"]).startswith("optimize.rates.motion.velocity=")
