"""Damaged checkpoints are passed over, and a run goes on from a whole one."""

import errno
import hashlib
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import ConfigError, MemoryLimitError, OutputError, as_clsplat_error
from clsplat.names import CHECKSUMS
from clsplat.runs import folders
from clsplat.training import archive
from tests.test_archive import written
from tests.test_records import records
from tests.test_training import train

pytestmark = pytest.mark.slow

FEW = ("optimize.steps=12", "init.count=60", "optimize.log_every=5", "checkpoint.every=4", "densify.every=4")
FEW += ("densify.start=3", "optimize.evaluate.every=6", "reset_opacity.every=100")


def model(out: Path) -> str:
    return hashlib.sha256((out / "point_cloud.ply").read_bytes()).hexdigest()


def steps_saved(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "checkpoints").iterdir())


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


def crafted(path: Path, change: Callable[[dict, dict], None]) -> None:
    """Write a checkpoint again, with right checksums and other contents."""
    notes, arrays = archive.read(path)
    arrays = {name: array.copy() for name, array in arrays.items()}
    change(notes, arrays)
    path.write_bytes(written(notes, arrays))


CRAFTED = {
    "cursor": lambda notes, arrays: notes.update(cursor=99),
    "a negative step": lambda notes, arrays: notes.update(step=-1),
    "no step": lambda notes, arrays: notes.pop("step"),
    "a word": lambda notes, arrays: notes.update(stage_step="4"),
    "degree": lambda notes, arrays: notes.update(degree=7),
    "updates": lambda notes, arrays: notes.update(updates={"means": 1}),
    "no table": lambda notes, arrays: arrays.pop("gaussians/quats"),
    "no moment": lambda notes, arrays: arrays.pop("adam/quats/moment1"),
    "no Gaussians": lambda notes, arrays: arrays.update({name: array[:0] for name, array in arrays.items()}),
    "rows": lambda notes, arrays: arrays.update({"adam/quats/moment1": arrays["adam/quats/moment1"][:-1]}),
    "columns": lambda notes, arrays: arrays.update({"gaussians/means": arrays["gaussians/means"][:, :2]}),
    "one axis": lambda notes, arrays: arrays.update({"stats/seen": arrays["stats/seen"][:, 0]}),
    "other numbers": lambda notes, arrays: arrays.update({"stats/seen": arrays["stats/seen"].astype(np.float64)}),
    "not finite": lambda notes, arrays: arrays["gaussians/means"].fill(np.nan),
    "a moment not finite": lambda notes, arrays: arrays["adam/quats/moment2"].fill(np.inf),
    "no settings": lambda notes, arrays: notes.update(pipeline={}, cursor=1),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_a_checkpoint_that_no_run_has_saved_is_passed_over(name, copy, tiny_scene, finished, caplog):
    crafted(copy / "checkpoints" / "step_000008.npz", CRAFTED[name])
    (copy / "checkpoints" / "step_000004.npz").write_bytes(b"")
    with pytest.raises(OutputError, match=r"step_000004.npz is damaged .*--restart` starts from the beginning"):
        train(tiny_scene, copy, *FEW, resume=True)
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len([text for text in warnings if re.search(r"step_000008.npz is damaged \(.+\); using", text)]) == 1


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:300], lambda data: data[:-30]])
def test_the_one_before_a_damaged_checkpoint_leads_to_the_same_bits(damage, copy, tiny_scene, finished, caplog):
    newest = copy / "checkpoints" / "step_000008.npz"
    shutil.copy(newest, copy / "checkpoints" / "step_000009.npz")
    last = copy / "checkpoints" / "step_000009.npz"
    last.write_bytes(damage(last.read_bytes()))
    train(tiny_scene, copy, *FEW, resume=True)
    assert model(copy) == model(finished)
    assert records(copy) == records(finished)
    kept = ["damaged_000009.npz", "step_000008.npz", "step_000012.npz"]
    assert steps_saved(copy) == kept, "the damaged one takes no place of a good one"


@pytest.mark.parametrize(
    ("error", "code"), [(MemoryError(), 5), (OSError(errno.ESTALE, "stale"), 7), (OSError(errno.EACCES, "refused"), 7)]
)
def test_a_checkpoint_that_cannot_be_read_just_now_is_not_damaged(error, code, copy, tiny_scene, finished, monkeypatch):
    shutil.copy(copy / "checkpoints" / "step_000008.npz", copy / "checkpoints" / "step_000009.npz")
    before, read = steps_saved(copy), zipfile.ZipFile.read

    def fail(archive, name):
        if archive.filename.endswith("step_000009.npz"):
            raise error
        return read(archive, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", fail)
    with pytest.raises((MemoryLimitError, OutputError)) as raised:
        train(tiny_scene, copy, *FEW, resume=True)
    failure = as_clsplat_error(raised.value)
    assert failure.exit_code == code
    assert code == 5 or f"step_000009.npz: cannot be read ({error.strerror}); check" in str(failure)
    assert steps_saved(copy) == before


def test_the_one_before_a_checkpoint_on_a_bad_part_of_the_disk_is_used(copy, tiny_scene, finished, monkeypatch, caplog):
    shutil.copy(copy / "checkpoints" / "step_000008.npz", copy / "checkpoints" / "step_000009.npz")
    read = zipfile.ZipFile.read

    def fail(archive, name):
        if archive.filename.endswith("step_000009.npz"):
            raise OSError(errno.EIO, "bad disk")
        return read(archive, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", fail)
    train(tiny_scene, copy, *FEW, resume=True)
    assert "bad disk)); using the one before it" in caplog.text
    assert model(copy) == model(finished)


def test_a_run_whose_checkpoints_are_gone_does_not_begin_again(copy, tiny_scene, finished):
    before = (copy / "metrics.jsonl").read_bytes()
    shutil.rmtree(copy / "checkpoints")
    with pytest.raises(OutputError, match=r"is empty, but step_000012.npz was saved there; .*--restart` starts"):
        train(tiny_scene, copy, *FEW, resume=True)
    assert (copy / "metrics.jsonl").read_bytes() == before


def test_a_run_without_a_checkpoint_so_far_begins_from_the_start(tiny_scene, tmp_path, caplog, finished):
    caplog.set_level("INFO", "clsplat")
    train(tiny_scene, tmp_path / "run", *FEW, resume=True)
    assert "nothing to resume; starting from the beginning" in caplog.text
    assert model(tmp_path / "run") == model(finished)


def test_restoring_reads_no_other_run(tiny_scene, tmp_path):
    """A folder with checkpoints and no pipeline.yaml is a run too."""
    train(tiny_scene, tmp_path, *FEW)
    (tmp_path / "pipeline.yaml").unlink()
    with pytest.raises(ConfigError, match="already holds a run; give another folder, --resume or --restart"):
        folders.check_run_folder(tmp_path, "new")
    assert CHECKSUMS in {path.name for path in tmp_path.iterdir()}
