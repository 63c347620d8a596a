"""Checkpoints: damage is noticed, a bad state never replaces a good one, and whatever fails leaves a state."""

import errno
import hashlib
import io
import json
import math
import os
import re
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.density.statistics import SplatStats
from clsplat.errors import ConfigError, DataError, DeviceError, NumericError, OutputError, as_clsplat_error
from clsplat.names import CHECKSUMS
from clsplat.opencl.program import Kernel
from clsplat.runs import folders
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.report import Report
from clsplat.training import archive, checkpoint
from clsplat.training.advice import lower_rate
from clsplat.training.run import Run
from clsplat.views.photographs import Photographs
from tests.test_training import train

pytestmark = pytest.mark.slow

FEW = ("optimize.steps=12", "init.count=60", "optimize.log_every=5", "checkpoint.every=4", "densify.every=4")
FEW += ("densify.start=3", "optimize.evaluate.every=6", "reset_opacity.every=100")


def model(out: Path) -> str:
    return hashlib.sha256((out / "point_cloud.ply").read_bytes()).hexdigest()


def records(out: Path) -> list[dict]:
    """The lines of metrics.jsonl without times."""
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{key: value for key, value in line.items() if key not in ("ms", "stages")} for line in lines]


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


# The archive


def written(notes: dict, arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    archive.write(file, notes, arrays.items())
    return file.getvalue()


NOTES = {"format": 4, "step": 7, "text": "é"}
ARRAYS = {"gaussians/means": np.arange(6, dtype=np.float32).reshape(2, 3), "none": np.zeros((2, 0), np.float32)}


def test_an_archive_returns_what_was_written_and_numpy_reads_it(tmp_path):
    (tmp_path / "a.npz").write_bytes(written(NOTES, ARRAYS))
    notes, arrays = archive.read(tmp_path / "a.npz")
    assert notes == NOTES
    assert arrays.keys() == ARRAYS.keys()
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        for name, array in ARRAYS.items():
            np.testing.assert_array_equal(arrays[name], array)
            np.testing.assert_array_equal(file[name], array)


@pytest.mark.parametrize("mask", [0xFF, 0x01, 0x80])
def test_every_changed_byte_is_noticed_or_harmless(mask, tmp_path):
    data, file = written(NOTES, ARRAYS), tmp_path / "a.npz"
    noticed = 0
    for place in range(len(data)):
        file.write_bytes(data[:place] + bytes([data[place] ^ mask]) + data[place + 1 :])
        try:
            notes, arrays = archive.read(file)
        except DataError:
            noticed += 1
            continue
        assert notes == NOTES, place
        assert arrays.keys() == ARRAYS.keys(), place
        for name, array in ARRAYS.items():
            assert arrays[name].dtype == np.float32
            np.testing.assert_array_equal(arrays[name], array, err_msg=str(place))
    assert noticed > 0.7 * len(data)


def test_every_cut_and_every_other_size_is_noticed(tmp_path):
    data, file = written(NOTES, ARRAYS), tmp_path / "a.npz"
    for size in range(len(data)):
        file.write_bytes(data[:size])
        with pytest.raises(DataError):
            archive.read(file)
    for fault in (b"", data[: len(data) // 2] * 2, os.urandom(4000)):
        file.write_bytes(fault)
        with pytest.raises(DataError):
            archive.read(file)


def test_sizes_are_compared_with_the_file_before_anything_is_read(tmp_path, monkeypatch):
    data, file = written(NOTES, ARRAYS), tmp_path / "a.npz"
    at = data.rindex(b"PK\x01\x02")  # in the list of contents: both sizes of the last member
    file.write_bytes(data[: at + 20] + b"\xf0\xff\xff\x7f" * 2 + data[at + 28 :])
    monkeypatch.setattr("zipfile.ZipFile.read", lambda *arguments: pytest.fail("was read"))
    with pytest.raises(DataError, match="declares more bytes than its"):
        archive.read(file)


# Damaged checkpoints of a run


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
    ("error", "code"), [(MemoryError(), 5), (OSError(errno.EIO, "bad disk"), 7), (OSError(errno.EACCES, "refused"), 7)]
)
def test_a_checkpoint_that_cannot_be_read_just_now_is_not_damaged(error, code, copy, tiny_scene, finished, monkeypatch):
    shutil.copy(copy / "checkpoints" / "step_000008.npz", copy / "checkpoints" / "step_000009.npz")
    before, read = steps_saved(copy), zipfile.ZipFile.read

    def fail(archive, name):
        if archive.filename.endswith("step_000009.npz"):
            raise error
        return read(archive, name)

    monkeypatch.setattr(zipfile.ZipFile, "read", fail)
    with pytest.raises((MemoryError, OutputError)) as raised:
        train(tiny_scene, copy, *FEW, resume=True)
    failure = as_clsplat_error(raised.value)
    assert failure.exit_code == code
    assert code == 5 or f"step_000009.npz: cannot be read ({error.strerror}); check" in str(failure)
    assert steps_saved(copy) == before


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


# States that are not finite


def breaks_at(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the means not finite in a step."""
    train_one = Run.changing
    run_step = {}

    def changing(run: Run):
        run_step["run"] = run
        return train_one(run)

    monkeypatch.setattr(Run, "changing", changing)
    add = SplatStats.add

    def add_and_break(stats, *arguments):
        add(stats, *arguments)
        if run_step["run"].step == step:
            stats.gaussians["means"].fill(np.nan)

    monkeypatch.setattr(SplatStats, "add", add_and_break)


@pytest.mark.parametrize(
    ("step", "log_every"), [(6, 5), (8, 100), (7, 1)], ids=["between", "at a checkpoint", "at once"]
)
def test_a_state_that_is_not_finite_is_never_a_checkpoint(step, log_every, tiny_scene, tmp_path, monkeypatch, finished):
    out, settings = tmp_path / "run", (*FEW, f"optimize.log_every={log_every}")
    breaks_at(step, monkeypatch)
    with pytest.raises(NumericError, match=r"not finite: means.*the state is in .*failed_0000\d\d.npz") as error:
        train(tiny_scene, out, *settings)
    assert len(steps_saved(out)) == 2
    assert steps_saved(out)[0].startswith("failed_")
    assert steps_saved(out)[1] == "step_000004.npz"
    command = re.search(r"`clsplat resume (\S+) --set (\S+)` .*goes on from step_000004.npz", str(error.value))
    assert command
    with pytest.raises(NumericError):  # and again, however often
        train(tiny_scene, out, *settings, resume=True)
    assert steps_saved(out)[1] == "step_000004.npz"
    monkeypatch.undo()
    train(tiny_scene, out, *settings, resume=True)
    assert model(out) == model(finished)


def test_a_loss_that_is_not_finite_leaves_no_newer_checkpoint(tiny_scene, tmp_path, monkeypatch):
    numbers = SimpleNamespace(isfinite=lambda value: False, log10=math.log10)
    monkeypatch.setattr("clsplat.stages.optimize.math", numbers)
    with pytest.raises(NumericError, match=r"parameters not finite: none; .*goes on from step_000004.npz"):
        train(tiny_scene, tmp_path, *FEW)
    assert steps_saved(tmp_path) == ["failed_000005.npz", "step_000004.npz"]


def test_the_advice_after_a_state_that_is_not_finite_works(tiny_scene, tmp_path, caplog):
    settings = (*FEW, "optimize.rates.sh_base=[[4, 0.01], [5, 1e38]]")
    with pytest.raises(NumericError) as error:
        train(tiny_scene, tmp_path, *settings)
    advice = re.search(r"`clsplat resume \S+ --set (optimize.rates.sh_base=\S+)`", str(error.value))
    assert advice, str(error.value)
    train(tiny_scene, tmp_path, *settings, advice[1], resume=True)
    assert "step 4: stages[1].optimize.rates.sh_base was " in caplog.text
    assert "from here on the bits are not those of a run without a change" in caplog.text
    changes = json.loads((tmp_path / "metrics.json").read_text())["changes"]
    assert len(changes) == 1
    assert changes[0].startswith("step 4: stages[1].optimize.rates.sh_base was ")
    train(tiny_scene, tmp_path, *settings, advice[1], resume=True)
    assert json.loads((tmp_path / "metrics.json").read_text())["changes"] == changes, "they stay with the run"


def test_the_advice_names_the_stage_that_trains(tiny_scene, tmp_path, finished):
    run = train(tiny_scene, tmp_path, *FEW)
    assert lower_rate(run, ["quats"]) == "optimize.rates.quats=0.0005"
    stages = run.pipeline["stages"]
    run.pipeline = {**run.pipeline, "stages": [*stages[:2], *stages[1:]]}
    assert lower_rate(run, []).startswith("stages.2.rates.")
    run.cursor = 1
    assert lower_rate(run, ["sh_rest"]) == "stages.1.rates.sh_rest=5e-05"
    run.pipeline = {**run.pipeline, "stages": [stages[0], stages[-1]]}
    assert lower_rate(run, ["means"]) == "optimize.rates.means=1.6e-05"


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


def test_a_stage_that_is_over_keeps_its_settings(copy, tiny_scene):
    crafted(copy / "checkpoints" / "step_000008.npz", lambda notes, arrays: notes.update(cursor=2, stage_step=0))
    with pytest.raises(ConfigError, match="was saved after that stage, at step 8"):
        train(tiny_scene, copy, *FEW, "optimize.steps=20", resume=True)


def test_a_run_that_stopped_after_its_last_stage_ends(copy, tiny_scene, finished):
    last = len(archive.read(copy / "checkpoints" / "step_000008.npz")[0]["pipeline"]["stages"])
    shutil.copy(finished / "checkpoints" / "step_000012.npz", copy / "checkpoints")
    crafted(copy / "checkpoints" / "step_000012.npz", lambda notes, arrays: notes.update(cursor=last, stage_step=0))
    shutil.copy(finished / "point_cloud.ply", copy)
    before = (copy / "checkpoints" / "step_000012.npz").read_bytes()
    assert train(tiny_scene, copy, *FEW, resume=True).step == 12
    assert json.loads((copy / "status.json").read_text())["state"] == "done"
    assert (copy / "checkpoints" / "step_000012.npz").read_bytes() == before


# Failures of every kind


def fails_at(step: int, monkeypatch: pytest.MonkeyPatch, where: str) -> type[Exception]:
    """Let a run fail in a step, in different places of it."""
    counts = {"photograph": 0, "kernel": 0}
    get, call = Photographs.get, Kernel.__call__

    def photograph(photographs, view):
        counts["photograph"] += 1
        if counts["photograph"] == step:
            raise DataError("the photograph is damaged")
        return get(photographs, view)

    def kernel(one, **values):
        if one.label == "blend.cl:blend_forward" or one.label.endswith(":blend_forward"):
            counts["kernel"] += 1
            if counts["kernel"] == step:
                raise DeviceError("the device is lost for a moment")
        return call(one, **values)

    if where == "photograph":
        monkeypatch.setattr(Photographs, "get", photograph)
        return DataError
    monkeypatch.setattr(Kernel, "__call__", kernel)
    return DeviceError


@pytest.mark.parametrize("where", ["photograph", "kernel"])
@pytest.mark.parametrize("step", [5, 6])  # 5: after the edit of step 4, before the update
def test_a_failure_inside_a_step_leaves_the_step_before(
    where, step, tiny_scene, tmp_path, monkeypatch, finished, caplog
):
    raised = fails_at(step, monkeypatch, where)
    with pytest.raises(raised):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    assert steps_saved(tmp_path)[-1] == f"step_00000{step - 1}.npz"
    assert f"the state of step {step - 1} is saved in {tmp_path}" in caplog.text
    status = json.loads((tmp_path / "status.json").read_text())
    assert (status["state"], status["step"], status["checkpoint"]) == ("failed", step - 1, steps_saved(tmp_path)[-1])
    train(tiny_scene, tmp_path, *FEW, resume=True)
    assert model(tmp_path) == model(finished)
    assert records(tmp_path) == records(finished)


@pytest.mark.parametrize(
    "error", [DataError("cut"), MemoryError(), ZeroDivisionError(), OSError(errno.EIO, "bad disk")]
)
@pytest.mark.parametrize("call", [1, 2], ids=["during", "after"])
def test_an_evaluation_that_fails_loses_nothing(error, call, tiny_scene, tmp_path, monkeypatch, finished):
    evaluate, calls = Evaluate.run, []

    def run(stage, run):
        calls.append(run.step)
        if len(calls) == 2 * call - 1:  # after step 6, and at the end
            raise error
        evaluate(stage, run)

    monkeypatch.setattr(Evaluate, "run", run)
    with pytest.raises(type(as_clsplat_error(error)), match=re.escape(str(as_clsplat_error(error)))):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    assert steps_saved(tmp_path)[-1] == ("step_000006.npz" if call == 1 else "step_000012.npz")
    train(tiny_scene, tmp_path, *FEW, resume=True)
    assert model(tmp_path) == model(finished)
    assert records(tmp_path) == records(finished)


def test_a_report_that_fails_is_written_when_the_run_goes_on(tiny_scene, tmp_path, monkeypatch, finished):
    def fail(stage, run):
        raise ZeroDivisionError

    monkeypatch.setattr(Report, "run", fail)
    with pytest.raises(Exception, match="ZeroDivisionError"):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    assert not (tmp_path / "report.html").exists()
    assert train(tiny_scene, tmp_path, *FEW, resume=True).step == 12
    assert (tmp_path / "report.html").exists()
    assert model(tmp_path) == model(finished)


@pytest.mark.parametrize("place", ["SplatStats.add", "Edit.apply"])
def test_a_step_that_is_half_done_is_not_saved(place, tiny_scene, tmp_path, monkeypatch, finished, caplog):
    name, method = place.split(".")
    kind = {"SplatStats": SplatStats, "Edit": __import__("clsplat.density.edit", fromlist=["Edit"]).Edit}[name]
    before, calls = getattr(kind, method), []

    def fail(*arguments):
        calls.append(1)
        if len(calls) == (7 if name == "SplatStats" else 2):
            raise MemoryError
        return before(*arguments)

    monkeypatch.setattr(kind, method, fail)
    with pytest.raises(Exception, match="out of memory"):
        train(tiny_scene, tmp_path, *FEW)
    monkeypatch.undo()
    newest = steps_saved(tmp_path)[-1]
    assert newest in ("step_000004.npz", "step_000008.npz")
    assert f"was not whole; the last good state is {tmp_path / 'checkpoints' / newest}" in caplog.text
    train(tiny_scene, tmp_path, *FEW, resume=True)
    assert model(tmp_path) == model(finished)
    assert records(tmp_path) == records(finished)


def test_a_state_that_cannot_be_saved_does_not_hide_the_failure(tiny_scene, tmp_path, monkeypatch, caplog):
    fails_at(6, monkeypatch, "photograph")
    save = checkpoint.save

    def full(run, keep=None):
        if run.step == 5:
            raise OutputError("the disk is full")
        return save(run, keep)

    monkeypatch.setattr(checkpoint, "save", full)
    with pytest.raises(DataError, match="the photograph is damaged"):
        train(tiny_scene, tmp_path, *FEW)
    assert "could not be saved (the disk is full); the last good state is " in caplog.text


def test_restoring_reads_no_other_run(tiny_scene, tmp_path):
    """A folder with checkpoints and no pipeline.yaml is a run too."""
    train(tiny_scene, tmp_path, *FEW)
    (tmp_path / "pipeline.yaml").unlink()
    with pytest.raises(ConfigError, match="already holds a run; give another folder, --resume or --restart"):
        folders.check_run_folder(tmp_path, "new")
    assert CHECKSUMS in {path.name for path in tmp_path.iterdir()}
