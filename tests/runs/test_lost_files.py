"""Files of a finished run that were lost or changed: made again where that can be, and named where it cannot."""

import json
import logging
import shutil
from pathlib import Path

import pytest

import clsplat
from clsplat.core.errors import ClsplatError, ConfigError, DeviceError, InternalError, Interrupted, OutputError
from clsplat.gaussians.model import load as load_model
from clsplat.opencl.device import Device
from clsplat.pipeline.matrix import load_experiment
from clsplat.runs import state
from clsplat.runs.model_file import ModelSource
from clsplat.stages.report import HtmlReport
from clsplat.sweeps.experiment import run_matrix
from clsplat.training.status import read_status
from clsplat.workflows.finetune import Tuning
from tests.support.commands import clsplat as command

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
    return [one["file"] for one in clsplat.check(out)["objects"] if not one["whole"]]


@pytest.fixture(scope="module")
def saved_late(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run whose checkpoint is behind all that it has written."""
    folder = tmp_path_factory.mktemp("late")
    (folder / "late.yaml").write_text(SAVED_LATE.format(scene=tiny_scene))
    return clsplat.run(str(folder / "late.yaml"), out=folder / "run")


@pytest.mark.parametrize("name", ["viewer.html", "report.html", "cameras/cameras.json", "point_cloud.ply"])
def test_a_file_whose_bytes_changed_is_written_again(name, saved_late, tmp_path):
    """Also where it still ends as a page does."""
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    whole = (out / name).read_bytes()
    (out / name).write_bytes(whole[:40] + b"x" * 20 + whole[60:])
    assert [path.name for path in state.changed(out)] == [Path(name).name]
    said = command("resume", out).stderr
    assert f"{name}: is missing or was changed; it is written again" in said or f"{name}: differs from what" in said
    assert clsplat.check(out)["whole"]
    assert b"x" * 20 not in (out / name).read_bytes()


def test_irreproducible_files_are_named_until_they_return(saved_late, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    records = out / "metrics.jsonl"
    records.write_text(records.read_text().replace('"step": 4', '"step": 3'))
    for _ in range(2):
        assert f"{records}: is missing or was changed since it was written, and cannot" in command("resume", out).stderr
        assert damaged(out) == ["metrics.jsonl"]
        assert read_status(out)["state"] == "done"
    assert f"`clsplat run {out}/pipeline.yaml --out {out} --restart`" in command("check", out, expect=7).stderr
    shutil.copy(saved_late / "metrics.jsonl", records)
    assert damaged(out) == []
    assert "cannot be made again" not in command("resume", out).stderr


def test_without_checksums_all_that_can_be_is_written_again(saved_late, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    (out / "checksums.json").unlink()
    viewer = (out / "viewer.html").read_bytes()
    (out / "viewer.html").write_bytes(viewer[:40] + b"x" * 20 + viewer[60:])
    assert "what can be is written again, the rest is not verified" in command("resume", out).stderr
    assert (out / "viewer.html").read_bytes() == viewer
    assert damaged(out) == []


def test_run_without_status_and_checkpoint_is_to_be_restarted(saved_late, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    shutil.rmtree(out / "checkpoints")
    (out / "status.json").unlink()
    assert (
        f"begin again: `clsplat run {out}/pipeline.yaml --out {out} --restart`"
        in command("check", out, expect=7).stderr
    )
    command("resume", out, expect=7)


@pytest.mark.parametrize("raised", [KeyboardInterrupt, ZeroDivisionError])
def test_stopped_resume_takes_no_damaged_file_as_complete(raised, saved_late, tmp_path, monkeypatch):
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    for name in ("viewer.html", "report.html"):
        (out / name).write_bytes((out / name).read_bytes().replace(b"a", b"b", 20))

    def stop(*arguments):
        raise raised

    with monkeypatch.context() as patch:
        patch.setattr(HtmlReport, "run", stop)
        with pytest.raises((Interrupted, InternalError)):
            clsplat.resume(out)
    assert read_status(out)["state"] in ("interrupted", "failed")
    assert damaged(out) == ["report.html"], "the other was written again"
    clsplat.resume(out)
    assert damaged(out) == []
    assert (out / "report.html").read_bytes().count(b"b") < (saved_late / "report.html").read_bytes().count(b"b") + 20


def test_lost_model_of_an_earlier_stage_leaves_the_run_done(tiny_scene, tmp_path):
    (tmp_path / "two.yaml").write_text(TWO_MODELS.format(scene=tiny_scene))
    out = clsplat.run(tmp_path / "two.yaml", out=tmp_path / "run")
    (out / "a.ply").unlink()
    (out / "b.ply").unlink()
    advice = f"begin again: `clsplat run {out}/pipeline.yaml --out {out} --restart`"
    said = command("check", out, expect=7).stderr
    assert said.endswith(f"{advice}; `clsplat resume {out}` makes them again but for {out}/a.ply\n")
    for _ in range(2):
        assert (
            f"{out}/a.ply: is missing or was changed since it was written, and cannot" in command("resume", out).stderr
        )
        assert read_status(out)["state"] == "done"
        assert damaged(out) == ["a.ply"]
        assert command("check", out, expect=7).stderr.endswith(f"{advice}\n")
    (out / "checksums.json").unlink()
    clsplat.resume(out)
    assert damaged(out) == ["a.ply"], "the checkpoint knows it too"


REFUSALS = {
    "no checkpoint": (
        ConfigError,
        {},
        r"has no checkpoint to go on from; `clsplat run \S+ --out \S+ --restart` trains",
    ),
    "a damaged checkpoint": (OutputError, {}, "no checkpoint is whole"),
    "another setting": (ConfigError, {"init.count": 51}, "was made with other settings"),
    "no such device": (DeviceError, {}, "nowhere"),
}


@pytest.mark.parametrize("name", REFUSALS)
def test_a_refused_resume_leaves_a_run_done(name, saved_late, tmp_path):
    kind, changes, words = REFUSALS[name]
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    (checkpoint,) = (out / "checkpoints").iterdir()
    if name == "no checkpoint":
        checkpoint.unlink()
    if name == "a damaged checkpoint":
        checkpoint.write_bytes(b"")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file() and path.name != "log.txt"}
    with pytest.raises(kind, match=words):
        clsplat.resume(out, set=changes, device="nowhere" if name == "no such device" else None)
    assert {path: path.read_bytes() for path in before} == before


def test_remedy_of_a_run_without_a_checkpoint_is_to_restart(saved_late, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(saved_late, out)
    shutil.rmtree(out / "checkpoints")
    status = read_status(out)
    del status["checkpoint"]
    (out / "status.json").write_text(json.dumps(status))
    (out / "point_cloud.ply").unlink()
    said = command("check", out, expect=7).stderr
    assert said.endswith(f"begin again: `clsplat run {out}/pipeline.yaml --out {out} --restart`\n")
    (out / "pipeline.yaml").unlink()
    assert f"give its `clsplat run … --out {out}` again, with --restart" in command("check", out, expect=7).stderr


@pytest.mark.parametrize(("name", "content"), [("metrics.json", ""), ("pipeline.yaml", ""), ("pipeline.yaml", None)])
def test_cell_that_lost_its_result_does_not_stop_the_comparison(name, content, tiny_scene, tmp_path):
    (tmp_path / "two.yaml").write_text(MATRIX.format(scene=tiny_scene))
    out = clsplat.run(tmp_path / "two.yaml", out=tmp_path / "run")
    cell = out / "seed=1"
    (cell / name).unlink()
    if content is not None:
        (cell / name).write_text(content)
    (out / "compare.html").unlink()
    for _ in range(2):
        named = "…" if name == "pipeline.yaml" else cell / "pipeline.yaml"
        with pytest.raises(ClsplatError, match=f"1 of 2 cells failed; .* `clsplat run {named} --out {cell} --restart`"):
            clsplat.resume(out)
    assert "seed=2" in (out / "compare.html").read_text()
    clsplat.run(tmp_path / "two.yaml", out=tmp_path / "other", set={"init.count": 50})
    clsplat.run(tmp_path / "other" / "seed=1" / "pipeline.yaml", out=cell, start="restart")
    clsplat.resume(out)
    assert damaged(out) == []


def test_a_cell_with_a_checkpoint_writes_its_result_again(tiny_scene, tmp_path):
    (tmp_path / "two.yaml").write_text(MATRIX.format(scene=tiny_scene) + "  - checkpoint\n")
    out = clsplat.run(tmp_path / "two.yaml", out=tmp_path / "run")
    (out / "seed=1" / "pipeline.yaml").write_text("")
    (out / "seed=2" / "metrics.json").unlink()
    clsplat.resume(out)
    assert damaged(out) == []
    records = out / "seed=1" / "metrics.jsonl"
    records.write_text(records.read_text() + "x")
    written = [path.stat().st_mtime_ns for path in out.glob("*/metrics.json")]
    clsplat.resume(out)
    assert [path.stat().st_mtime_ns for path in out.glob("*/metrics.json")] == written, "nothing would come back"
    assert damaged(out) == ["seed=1/metrics.jsonl"]


def test_a_cell_without_a_checkpoint_that_lost_a_file_is_kept(tiny_scene, tmp_path, caplog):
    (tmp_path / "two.yaml").write_text(MATRIX.format(scene=tiny_scene))
    matrix = load_experiment(str(tmp_path / "two.yaml"))
    assert matrix is not None
    run_matrix(matrix, tmp_path / "run", None, "new")
    lost = tmp_path / "run" / "seed=1" / "point_cloud.ply"
    lost.unlink()
    with caplog.at_level(logging.WARNING, "clsplat"):
        run_matrix(matrix, tmp_path / "run", None, "resume")
    assert f"{lost}: is missing or was changed; without a checkpoint only --restart makes it again" in caplog.text
    assert json.loads((tmp_path / "run" / "status.json").read_text())["failed"] == {}
    assert "seed=1" in (tmp_path / "run" / "compare.html").read_text()


@pytest.mark.parametrize("content", [None, b"", b"ply\n"])
def test_a_rung_that_lost_its_model_is_trained_again(content, few_steps, info, tmp_path):
    """Compress and lod would publish a damaged one."""
    source = ModelSource.of(few_steps, None)
    model = load_model(source.file)
    tuning = Tuning("rungs", source, model, 3, Device(info))
    pipeline = tuning.pipeline(("init", "optimize"), {"init.file": str(source.file.resolve())})
    file = tuning.trained(pipeline, tmp_path / "rung")
    whole = file.read_bytes()
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    assert tuning.trained(pipeline, tmp_path / "rung").read_bytes() == whole
    written = file.stat().st_mtime_ns
    tuning.trained(pipeline, tmp_path / "rung")
    assert file.stat().st_mtime_ns == written
    shutil.rmtree(tmp_path / "rung" / "checkpoints")
    (tmp_path / "rung" / "status.json").unlink()  # no command of theirs has --restart
    assert tuning.trained(pipeline, tmp_path / "rung").read_bytes() == whole


def test_run_killed_before_it_began_says_how_to_begin(tmp_path):
    """As by `kill -9` while the device is proved: there is no pipeline to go on with."""
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "status.json").write_text('{"state": "preparing", "process": 4194305}')
    again = f"give its `clsplat run … --out {tmp_path / 'run'} --resume` again"
    assert again in command("resume", tmp_path / "run", expect=3).stderr
    assert f"give its `clsplat run … --out {tmp_path / 'run'}` again, with --resume" in (
        command("check", tmp_path / "run", expect=7).stderr
    )
