"""Retention of checkpoints: old ones are removed, and files that cannot be removed do not end a run."""

from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import NotFiniteError
from clsplat.training import checkpoint

FEW = {"optimize.steps": 9, "init.count": 20, "checkpoint.every": 100, "optimize.log_every": 100}
pytestmark = pytest.mark.slow


@pytest.fixture
def run(tiny_scene, tmp_path):
    """A run that has saved its first step, and done the second."""
    trainer = clsplat.Trainer(tiny_scene, "smoke", set=FEW, out=tmp_path / "run")
    trainer.step()
    checkpoint.save(trainer._run)
    trainer.step()
    yield trainer._run
    trainer.close()


@pytest.fixture
def locked_names(monkeypatch):
    """Files of these names cannot be removed or renamed, as on Windows where another program reads them."""
    names = set()
    for function in ("unlink", "rename"):
        real = getattr(Path, function)

        def refusing(path, *arguments, real=real, **values):
            if path.name in names:
                raise PermissionError(13, "in use", str(path))
            return real(path, *arguments, **values)

        monkeypatch.setattr(Path, function, refusing)
    return names


def names_of(run) -> list[str]:
    return sorted(path.name for path in (run.out / "checkpoints").iterdir())


def test_unremovable_older_checkpoint_stays_and_is_reported(run, locked_names, caplog):
    locked_names.add("step_000001.npz")
    for _ in range(2):
        checkpoint.save(run, keep=1)
    assert names_of(run) == ["step_000001.npz", "step_000002.npz"]
    (record,) = (record for record in caplog.records if "step_000001.npz" in record.getMessage())
    assert "cannot be removed (in use); a later save tries again" in record.getMessage()


def test_unremovable_failed_state_does_not_hide_the_advice(run, locked_names):
    locked_names.add("failed_000000.npz")
    (run.out / "checkpoints" / "failed_000000.npz").touch()
    run.model.gaussians["means"].fill(np.nan)
    with pytest.raises(NotFiniteError, match=r"the state is in .*failed_000002.npz; .*resume from step_000001.npz"):
        checkpoint.save(run)


def test_unrenamable_damaged_checkpoint_does_not_count(run, locked_names, caplog):
    later = run.out / "checkpoints" / "step_000009.npz"
    later.touch()
    locked_names.add(later.name)
    checkpoint.rename_damaged(run.out, run.out / "checkpoints" / "step_000001.npz")
    assert "step_000009.npz: cannot be renamed (in use)" in caplog.text
    checkpoint.save(run, keep=1)
    assert names_of(run) == ["step_000002.npz", "step_000009.npz"]
