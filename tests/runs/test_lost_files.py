"""Lost or changed files of a finished run: its last stages run again, and unrecoverable files are named."""

import shutil
from pathlib import Path

import pytest

import clsplat
from clsplat.core.errors import ClsplatError, ConfigError, DeviceError, InternalError, Interrupted, OutputError
from clsplat.gaussians.model import load as load_model
from clsplat.opencl.device import Device
from clsplat.runs import opening, state
from clsplat.runs.model_file import ModelSource
from clsplat.stages.report import HtmlReport
from clsplat.training.status import read_status
from clsplat.workflows.finetune import Tuning
from tests.support.commands import clsplat as command
from tests.support.runs import records

pytestmark = pytest.mark.slow

SAVED_LATE = """
name: late
scene: {{path: '{scene}'}}
stages:
  - init: {{count: 50}}
  - optimize: {{steps: 4, losses: [l1]}}
  - evaluate
  - export
  - cameras
  - viewer: {{file: viewer.html, photographs: test}}
  - report
  - checkpoint
"""
MATRIX = """
name: two
matrix: {{set: {{seed: [1, 2]}}}}
scene: {{path: '{scene}'}}
stages:
  - init: {{count: 50}}
  - optimize: {{steps: 4, losses: [l1]}}
  - evaluate
  - export
"""


TWO_MODELS = """
name: models
scene: {{path: '{scene}'}}
stages:
  - init: {{count: 50}}
  - optimize: {{steps: 2, losses: [l1]}}
  - export: {{file: a.ply}}
  - optimize: {{steps: 2, losses: [l1]}}
  - evaluate
  - export: {{file: b.ply}}
  - checkpoint
"""


def damaged(out: Path) -> list[str]:
    return [item["file"] for item in clsplat.check(out)["objects"] if not item["whole"]]


@pytest.fixture(scope="module")
def saved_late(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run whose checkpoint is older than its outputs."""
    folder = tmp_path_factory.mktemp("late")
    (folder / "late.yaml").write_text(SAVED_LATE.format(scene=tiny_scene))
    return clsplat.run(str(folder / "late.yaml"), out=folder / "run")


@pytest.fixture
def copy(saved_late: Path, tmp_path: Path) -> Path:
    return shutil.copytree(saved_late, tmp_path / "run")


def change(path: Path) -> None:
    """Change bytes of a file but not its end."""
    whole = path.read_bytes()
    path.write_bytes(whole[:40] + b"x" * 20 + whole[60:])


def test_last_stages_run_again_if_files_are_lost(saved_late, copy):
    names = "viewer.html", "report.html", "cameras/cameras.json", "point_cloud.ply"
    for name in names:
        change(copy / name)
    (copy / "metrics.json").unlink()
    assert sorted(state.RunState.read(copy).bad_files) == sorted([*names, "metrics.json"])
    command("resume", copy)
    assert damaged(copy) == []
    assert (copy / "point_cloud.ply").read_bytes() == (saved_late / "point_cloud.ply").read_bytes()
    assert records(copy) == records(saved_late), "what they have noted is not there twice"


def test_complete_finished_run_does_not_change(copy, monkeypatch, caplog):
    monkeypatch.setattr(opening, "open_run", lambda *arguments: pytest.fail("opened a device"))
    written = (copy / "status.json").read_bytes()
    with caplog.at_level("INFO", "clsplat"):
        clsplat.resume(copy)
    assert f"{copy}: the outputs are complete and up to date" in caplog.text
    assert (copy / "status.json").read_bytes() == written


def test_missing_records_are_named_until_restored(saved_late, copy):
    (copy / "metrics.jsonl").write_text((copy / "metrics.jsonl").read_text().replace('"step": 4', '"step": 3'))
    for _ in range(2):
        said = command("resume", copy).stderr
        assert f"{copy / 'metrics.jsonl'}: is missing or has changed; only --restart writes it again" in said
        assert damaged(copy) == ["metrics.jsonl"]
        assert read_status(copy)["state"] == "done"
    shutil.copy(saved_late / "metrics.jsonl", copy / "metrics.jsonl")
    assert damaged(copy) == []


@pytest.mark.parametrize("raised", [KeyboardInterrupt, ZeroDivisionError])
def test_stopped_resume_accepts_no_damaged_file(raised, copy, monkeypatch):
    for name in ("viewer.html", "report.html", "metrics.jsonl"):
        change(copy / name)

    def stop(*arguments):
        raise raised

    with monkeypatch.context() as patch:
        patch.setattr(HtmlReport, "run", stop)
        with pytest.raises((Interrupted, InternalError)):
            clsplat.resume(copy)
    assert read_status(copy)["state"] in ("interrupted", "failed")
    assert "metrics.jsonl" in damaged(copy)
    clsplat.resume(copy)
    assert damaged(copy) == ["metrics.jsonl"]


def test_lost_model_of_an_earlier_stage_leaves_the_run_done(tiny_scene, tmp_path):
    (tmp_path / "two.yaml").write_text(TWO_MODELS.format(scene=tiny_scene))
    out = clsplat.run(tmp_path / "two.yaml", out=tmp_path / "run")
    (out / "b.ply").unlink()
    change(out / "a.ply")
    assert command("check", out, expect=7).stderr.endswith(
        f"`clsplat resume {out}` repeats the stages after its newest checkpoint\n"
    )
    for lost in ("b.ply", "checksums.json"):
        (out / lost).unlink(missing_ok=True)
        said = command("resume", out).stderr
        assert f"{out}/a.ply: is missing or has changed; only --restart writes it again" in said
        assert read_status(out)["state"] == "done"
        assert damaged(out) == ["a.ply"], "also without its checksum: the checkpoint has one"


REFUSALS = {
    "no checkpoint": (
        ConfigError,
        {},
        r"has no checkpoint to continue from; `clsplat run \S+ --out \S+ --restart` trains",
    ),
    "a damaged checkpoint": (OutputError, {}, "and so are all other checkpoints"),
    "another setting": (ConfigError, {"init.count": 51}, "was saved with other settings"),
    "no such device": (DeviceError, {}, "nowhere"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_refused_resume_leaves_a_run_done(name, copy):
    kind, changes, words = REFUSALS[name]
    (copy / "viewer.html").unlink()
    (checkpoint,) = (copy / "checkpoints").iterdir()
    if name == "no checkpoint":
        checkpoint.unlink()
    if name == "a damaged checkpoint":
        checkpoint.write_bytes(b"")
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file() and path.name != "log.txt"}
    with pytest.raises(kind, match=words):
        clsplat.resume(copy, set=changes, device="nowhere" if name == "no such device" else None)
    assert {path: path.read_bytes() for path in before} == before


def test_remedy_without_a_checkpoint_is_to_restart(copy):
    shutil.rmtree(copy / "checkpoints")
    (copy / "point_cloud.ply").unlink()
    for _ in ("done", "its status is lost too"):
        advice = f"start over: `clsplat run {copy}/pipeline.yaml --out {copy} --restart`\n"
        assert command("check", copy, expect=7).stderr.endswith(advice)
        assert "--restart`" in command("resume", copy, expect=2 if (copy / "status.json").exists() else 7).stderr
        (copy / "status.json").unlink(missing_ok=True)


def test_matrix_cells_with_lost_files_run_again(tiny_scene, tmp_path):
    """One with a checkpoint has them again; one without is named, and does not stop the comparison."""
    (tmp_path / "two.yaml").write_text(MATRIX.format(scene=tiny_scene) + "  - checkpoint\n")
    out = clsplat.run(tmp_path / "two.yaml", out=tmp_path / "run")
    written = (out / "seed=1" / "metrics.json").stat().st_mtime_ns
    (out / "seed=2" / "pipeline.yaml").write_text("")
    (out / "seed=2" / "point_cloud.ply").unlink()
    clsplat.resume(out)
    assert damaged(out) == []
    assert (out / "seed=1" / "metrics.json").stat().st_mtime_ns == written
    cell = out / "seed=1"
    shutil.rmtree(cell / "checkpoints")
    for name, file in (("point_cloud.ply", cell / "pipeline.yaml"), ("pipeline.yaml", "…")):
        (cell / name).unlink()
        (out / "compare.html").unlink()
        with pytest.raises(ClsplatError, match=f"1 of 2 cells failed; .* `clsplat run {file} --out {cell} --restart`"):
            clsplat.resume(out)
        assert "seed=2" in (out / "compare.html").read_text()
    clsplat.run(out / "seed=2" / "pipeline.yaml", out=cell, start="restart", set={"seed": 1})
    clsplat.resume(out)
    assert damaged(out) == []


@pytest.mark.parametrize("content", [None, b"", b"ply\n"])
def test_candidate_without_its_model_is_trained_again(content, few_steps, info, tmp_path):
    """Otherwise `compress` and `lod` would publish a damaged model."""
    source = ModelSource.from_model(few_steps, None)
    model = load_model(source.file)
    tuning = Tuning("rungs", source, model, 3, Device(info))
    pipeline = tuning.pipeline(("init", "optimize"), {"init.file": str(source.file.resolve())})
    file = tuning.train(pipeline, tmp_path / "rung")
    whole = file.read_bytes()
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    assert tuning.train(pipeline, tmp_path / "rung").read_bytes() == whole
    written = file.stat().st_mtime_ns
    tuning.train(pipeline, tmp_path / "rung")
    assert file.stat().st_mtime_ns == written
    shutil.rmtree(tmp_path / "rung" / "checkpoints")
    (tmp_path / "rung" / "status.json").unlink()  # no command of theirs has --restart
    assert tuning.train(pipeline, tmp_path / "rung").read_bytes() == whole


def test_run_killed_before_its_start_has_a_remedy(tmp_path):
    """As by `kill -9` while the device is proved: there is no pipeline to go on with."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "status.json").write_text('{"state": "preparing", "process": 4194305}')
    again = f"run its `clsplat run … --out {tmp_path / 'run'} --resume` again"
    assert again in command("resume", tmp_path / "run", expect=3).stderr
    assert f"run its `clsplat run … --out {tmp_path / 'run'}` again, with --resume" in (
        command("check", tmp_path / "run", expect=7).stderr
    )
