"""Damaged checkpoints are skipped, and a run resumes from an intact one."""

import errno
import json
import re
import shutil
import zipfile

import numpy as np
import pytest

import clsplat
from clsplat.core.errors import ConfigError, DataError, MemoryLimitError, OutputError, as_clsplat_error
from clsplat.core.files import CHECKSUMS
from clsplat.runs import run_folder
from clsplat.runs.state import RunState
from tests.support.runs import FEW, crafted, digest, records, steps_saved, train

pytestmark = pytest.mark.slow


CRAFTED = {
    "stage": lambda notes, arrays: notes.update(stage_index=99),
    "a negative step": lambda notes, arrays: notes.update(step=-1),
    "no step": lambda notes, arrays: notes.pop("step"),
    "a word": lambda notes, arrays: notes.update(stage_step="4"),
    "degree": lambda notes, arrays: notes.update(degree=7),
    "too few harmonics": lambda notes, arrays: (
        notes.update(degree=3),
        arrays.update({name: array[:, :9] for name, array in arrays.items() if "sh_rest" in name}),
    ),
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
    "endless records": lambda notes, arrays: notes.update(records=10**30),
    "time that is not a number": lambda notes, arrays: notes.update(train_seconds=float("nan")),
    "words as metrics": lambda notes, arrays: notes.update(
        metrics={"test": {"1": {"psnr": "x", "ssim": 1, "views": 2}}}
    ),
    "an unknown split": lambda notes, arrays: notes.update(metrics={"x": {}}),
    "no scene": lambda notes, arrays: notes["pipeline"].pop("scene"),
    "no settings": lambda notes, arrays: notes.update(pipeline={}, stage_index=1),
}


@pytest.mark.parametrize("name", CRAFTED)
def test_foreign_checkpoint_is_skipped(name, killed_run, tiny_scene, few_steps, caplog):
    crafted(killed_run / "checkpoints" / "step_000008.npz", CRAFTED[name])
    (killed_run / "checkpoints" / "step_000004.npz").write_bytes(b"")
    with pytest.raises(OutputError, match=r"step_000004.npz is damaged .*start over with .*--restart`"):
        train(tiny_scene, killed_run, *FEW, resume=True)
    warnings = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert len([text for text in warnings if re.search(r"step_000008.npz is damaged \(.+\); using", text)]) == 1


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: data[:300], lambda data: data[:-30]])
def test_checkpoint_before_a_damaged_one_gives_the_same_bits(damage, killed_run, tiny_scene, few_steps, caplog):
    newest = killed_run / "checkpoints" / "step_000008.npz"
    shutil.copy(newest, killed_run / "checkpoints" / "step_000009.npz")
    last = killed_run / "checkpoints" / "step_000009.npz"
    last.write_bytes(damage(last.read_bytes()))
    train(tiny_scene, killed_run, *FEW, resume=True)
    assert digest(killed_run) == digest(few_steps)
    assert records(killed_run) == records(few_steps)
    kept = ["damaged_000009.npz", "step_000008.npz", "step_000012.npz"]
    assert steps_saved(killed_run) == kept, "the damaged one takes no place of a good one"


@pytest.mark.parametrize(
    ("error", "code"), [(MemoryError(), 5), (OSError(errno.ESTALE, "stale"), 7), (OSError(errno.EACCES, "refused"), 7)]
)
def test_momentarily_unreadable_checkpoint_is_not_damaged(error, code, killed_run, tiny_scene, few_steps, monkeypatch):
    shutil.copy(killed_run / "checkpoints" / "step_000008.npz", killed_run / "checkpoints" / "step_000009.npz")
    before, read = steps_saved(killed_run), zipfile.ZipFile.read

    def fail(archive, name):
        if archive.filename.endswith("step_000009.npz"):
            raise error
        return read(archive, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", fail)
    with pytest.raises((MemoryLimitError, OutputError)) as raised:
        train(tiny_scene, killed_run, *FEW, resume=True)
    failure = as_clsplat_error(raised.value)
    assert failure.exit_code == code
    assert code == 5 or f"step_000009.npz: cannot be read ({error.strerror}); check" in str(failure)
    assert steps_saved(killed_run) == before


def test_checkpoint_before_an_unreadable_one_is_used(killed_run, tiny_scene, few_steps, monkeypatch, caplog):
    shutil.copy(killed_run / "checkpoints" / "step_000008.npz", killed_run / "checkpoints" / "step_000009.npz")
    read = zipfile.ZipFile.read

    def fail(archive, name):
        if archive.filename.endswith("step_000009.npz"):
            raise OSError(errno.EIO, "bad disk")
        return read(archive, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", fail)
    train(tiny_scene, killed_run, *FEW, resume=True)
    assert "step_000009.npz is damaged (it cannot be read from disk: bad disk); using an earlier one" in caplog.text
    assert digest(killed_run) == digest(few_steps)


def test_run_without_its_checkpoints_does_not_restart(killed_run, tiny_scene, few_steps):
    before = (killed_run / "metrics.jsonl").read_bytes()
    shutil.rmtree(killed_run / "checkpoints")
    status = json.loads((killed_run / "status.json").read_text())
    (killed_run / "status.json").write_text(json.dumps({**status, "state": "running"}))
    with pytest.raises(OutputError, match=r"step_000012.npz is missing; .*start over with .*--restart`"):
        train(tiny_scene, killed_run, *FEW, resume=True)
    assert (killed_run / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize("status", [None, ""])
def test_run_without_its_status_does_not_restart(killed_run, tiny_scene, few_steps, status):
    before = (killed_run / "metrics.jsonl").read_bytes()
    shutil.rmtree(killed_run / "checkpoints")
    (killed_run / "status.json").unlink()
    if status is not None:
        (killed_run / "status.json").write_text(status)
    with pytest.raises(OutputError, match=r"both status\.json and the checkpoints of its run are missing; .*--restart"):
        train(tiny_scene, killed_run, *FEW, resume=True)
    assert (killed_run / "metrics.jsonl").read_bytes() == before


def test_run_before_its_first_checkpoint_restarts(tiny_scene, tmp_path, caplog, few_steps):
    caplog.set_level("INFO", "clsplat")
    train(tiny_scene, tmp_path / "run", *FEW, resume=True)
    assert "nothing to resume; starting from the beginning" in caplog.text
    assert digest(tmp_path / "run") == digest(few_steps)


def test_restoring_reads_no_other_run(few_steps, tmp_path):
    """A folder with checkpoints and no pipeline.yaml is a run too."""
    out = shutil.copytree(few_steps, tmp_path / "run")
    (out / "pipeline.yaml").unlink()
    with pytest.raises(ConfigError, match="already has a run; use another folder, --resume, or --restart"):
        run_folder.check_run_folder(RunState.read(out), "new")
    assert CHECKSUMS in {path.name for path in out.iterdir()}


def test_run_with_a_moved_scene_resumes(killed_run, few_steps, tiny_scene, tmp_path):
    pipeline, moved = killed_run / "pipeline.yaml", shutil.copytree(tiny_scene, tmp_path / "moved" / tiny_scene.name)
    pipeline.write_text(pipeline.read_text().replace(str(tiny_scene), str(tmp_path / "gone")))
    remedy = rf"photos, {tmp_path / 'gone'}, is missing; if you moved it, run `clsplat resume {killed_run} --scene DIR`"
    with pytest.raises(DataError, match=remedy):
        clsplat.resume(killed_run)
    clsplat.resume(killed_run, moved)
    assert (killed_run / "point_cloud.ply").read_bytes() == (few_steps / "point_cloud.ply").read_bytes()


def test_checkpoints_by_time_do_not_change_the_bits(tiny_scene, few_steps, tmp_path):
    train(tiny_scene, tmp_path / "run", *FEW, "checkpoint.every_seconds=1e-6", "checkpoint.keep=20")
    assert steps_saved(tmp_path / "run") == [f"step_{step:06d}.npz" for step in range(1, 13)]
    assert digest(tmp_path / "run") == digest(few_steps)
    assert records(tmp_path / "run") == records(few_steps)
    train(tiny_scene, tmp_path / "rare", *FEW, "checkpoint.every_seconds=1e6")
    assert steps_saved(tmp_path / "rare") == steps_saved(few_steps)
