"""`clsplat check RUN` detects every change in a run folder."""

import json
import os
import shutil
from pathlib import Path

import jsonschema
import pytest

import clsplat
from clsplat.core.errors import DataError
from clsplat.opencl import device
from clsplat.runs.state import RunState
from clsplat.runs.verify import verify
from tests.support.commands import clsplat as command

pytestmark = pytest.mark.slow

SET = {"optimize.steps": 20, "init.count": 60}
TINY = """
name: two
matrix: {{set: {{seed: [1, 2]}}}}
scene: {{path: '{scene}'}}
stages:
  - init: {{count: 50}}
  - optimize: {{steps: 4, losses: [l1], during: [{{checkpoint: {{every: 2}}}}]}}
  - evaluate
  - export
"""


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return clsplat.run("smoke", tiny_scene, tmp_path_factory.mktemp("runs") / "run", set=SET)


@pytest.fixture
def copy(finished: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def damaged(out: Path) -> dict[str, str]:
    """The damaged files, with reasons."""
    result = clsplat.check(out)
    assert result["whole"] == all(item["whole"] for item in result["objects"])
    return {item["file"]: item["detail"] for item in result["objects"] if not item["whole"]}


def test_status_of_a_newer_version_is_not_damage(copy):
    """A key that is new does not change the format; one of another format is not judged."""
    path = copy / "status.json"
    status = json.loads(path.read_text())
    newer = {**status, "new": 1, "progress": {"done": 1, "total": 2, "unit": "steps", "new": "x"}}
    jsonschema.validate(newer, clsplat.status_schema())
    path.write_text(json.dumps(newer))
    assert damaged(copy) == {}
    assert clsplat.status(copy)["new"] == 1
    path.write_text(json.dumps({**status, "format": 2, "step": "of words"}))
    assert damaged(copy) == {}
    details = {item["file"]: item["detail"] for item in clsplat.check(copy)["objects"]}
    assert details["status.json"] == "not checked further: format 2 of a newer version"
    for fault in ({"step": "of words"}, {"format": 0}, {"format": "1"}):
        path.write_text(json.dumps({**status, **fault}))
        assert list(damaged(copy)) == ["status.json"]
    for name in ("format", "state", "version"):
        path.write_text(json.dumps({key: value for key, value in status.items() if key != name}))
        assert damaged(copy)["status.json"] == f"{name}: Field required"


def test_complete_run_has_a_line_per_file_and_needs_no_device(finished, monkeypatch):
    monkeypatch.setattr(device, "Device", lambda *arguments: pytest.fail("opens a device"))
    assert damaged(finished) == {}
    done = command("check", finished)
    lines = done.stdout.splitlines()
    assert lines[-1] == f"{finished}: done; all {len(lines) - 1} files are intact"
    text = "\n".join(lines)
    names = ["pipeline.yaml", "status.json, done", "checkpoints/step_000020.npz, step 20, ", "metrics.jsonl, "]
    names += ["metrics.json, ", "point_cloud.ply, ", "renders/test/", "report.html", "checksums.json, of 8 files"]
    names += ["viewer.html"]
    assert [name for name in names if name not in text] == []
    data = json.loads(command("check", finished, "--json").stdout)
    assert data == clsplat.check(finished)
    assert (data["state"], data["whole"]) == ("done", True)


def test_checksums_match_sha256sum(finished):
    sums = json.loads((finished / "checksums.json").read_text())
    import hashlib

    for name, value in sums.items():
        assert hashlib.sha256((finished / name).read_bytes()).hexdigest() == value
    assert {"pipeline.yaml", "metrics.json", "metrics.jsonl", "point_cloud.ply", "report.html"} < set(sums)


def test_changed_byte_in_any_file_is_detected(finished, copy):
    files = [item["file"] for item in clsplat.check(finished)["objects"] if item["file"] != "status.json"]
    assert len(files) > 9
    for name in files:
        data = (copy / name).read_bytes()
        place = len(data) // 2
        (copy / name).write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        result = damaged(copy)
        assert name in result or name == "checksums.json", name
        assert result, name
        (copy / name).write_bytes(data)
    assert damaged(copy) == {}


@pytest.mark.parametrize("content", [None, b"", b"\xff\x00", b"[]"])
def test_missing_or_replaced_file_is_detected(content, finished, copy):
    older = min(path.relative_to(finished).as_posix() for path in finished.glob("checkpoints/*"))
    for item in clsplat.check(finished)["objects"]:
        path = copy / item["file"]
        data = path.read_bytes()
        path.unlink() if content is None else path.write_bytes(content)
        result = damaged(copy)
        if not (content is None and item["file"] == older):
            assert result, item["file"]
        path.write_bytes(data)


def test_damage_ends_with_exit_code_7_and_one_line(copy):
    (copy / "point_cloud.ply").write_bytes((copy / "point_cloud.ply").read_bytes()[:-4])
    (copy / "checkpoints" / "step_000020.npz").write_bytes(b"")
    done = command("check", copy, expect=7)
    assert "DAMAGED  point_cloud.ply, does not match its checksum" in done.stdout
    assert "files are damaged or missing: checkpoints/step_000020.npz, point_cloud.ply; " in done.stderr
    data = json.loads(command("check", copy, "--json", expect=7).stdout)
    assert data["whole"] is False


def test_killed_run_is_complete_without_outputs(copy):
    for name in ("checksums.json", "metrics.json", "point_cloud.ply", "report.html"):
        (copy / name).unlink()
    status = json.loads((copy / "status.json").read_text())
    (copy / "status.json").write_text(json.dumps({**status, "state": "running"}))
    assert damaged(copy) == {}
    (copy / "status.json").write_text(json.dumps({**status, "state": "done"}))
    gone = damaged(copy)
    assert set(gone) == {"checksums.json", "metrics.json", "point_cloud.ply", "report.html"}
    assert gone["report.html"] == "is missing"


@pytest.mark.parametrize("name", ["inputs.json", "checksums.json", "checkpoints/step_000020.npz", "report.html"])
def test_missing_outputs_of_a_finished_run_are_detected(name, copy):
    (copy / name).unlink()
    assert set(damaged(copy)) == {name}


def test_missing_renders_are_detected(copy):
    shutil.rmtree(copy / "renders")
    assert damaged(copy)
    assert all(name.startswith("renders/test/") for name in damaged(copy))


def test_list_without_a_declared_output_is_damaged(copy):
    (copy / "checksums.json").write_text("{}")
    names = ["pipeline.yaml", "metrics.jsonl", "metrics.json", "point_cloud.ply", "viewer.html", "report.html"]
    assert damaged(copy) == {"checksums.json": f"lacks {', '.join(map(repr, names))}"}
    (copy / "checksums.json").write_text('{"../a": "", "/b": ""}')
    assert damaged(copy)["checksums.json"].startswith(
        "'../a' is not a file of the run; '/b' is not a file of the run; lacks "
    )


KINDS = {
    "is a folder": Path.mkdir,
    "is a pipe": getattr(os, "mkfifo", None),
    "is a broken link": lambda path: path.symlink_to("nowhere"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_kind_of_file_is_reported(kind, finished, copy):
    if (make := KINDS[kind]) is None:
        pytest.skip("this system has no pipes with names")
    for name in [item["file"] for item in clsplat.check(finished)["objects"]]:
        (copy / name).unlink()
        make(copy / name)
        result = damaged(copy)
        assert result.keys() == {name}
        assert kind in result[name], (name, result[name])
        (copy / name).rmdir() if kind == "is a folder" else (copy / name).unlink()
        shutil.copyfile(finished / name, copy / name)


def test_every_missing_file_is_named(finished, copy):
    """The list of checksums tells them, or the pipeline, or what every run has."""
    files = {item["file"] for item in clsplat.check(finished)["objects"]}
    outputs = {name for name in files if name.endswith((".ply", ".html", ".png"))}
    of_every_run = {"inputs.json", "metrics.json", "metrics.jsonl"}
    newest = {"checkpoints/step_000020.npz"}
    pages = {name for name in outputs if not name.startswith("renders/")}
    for kept, told in (
        ({"checksums.json", "pipeline.yaml"}, of_every_run | outputs | {"status.json"}),
        ({"checksums.json", "status.json"}, of_every_run | outputs | newest | {"pipeline.yaml"}),
        ({"pipeline.yaml", "status.json"}, of_every_run | pages | newest | {"checksums.json"}),
        ({"status.json"}, of_every_run | newest | {"pipeline.yaml", "checksums.json"}),
    ):
        shutil.rmtree(copy)
        shutil.copytree(finished, copy)
        for name in files - kept:
            (copy / name).unlink()
        for folder in (copy / "renders" / "test", copy / "renders"):
            folder.rmdir()
        assert damaged(copy).keys() == told, kept


def test_run_without_checksums_is_not_reported_as_complete(copy):
    (copy / "checksums.json").unlink()
    done = command("check", copy, expect=7)
    assert "checksums.json is missing, as in every run of a Trainer" in done.stderr
    assert "whole" not in done.stderr


def test_every_file_has_one_line(finished):
    files = [item["file"] for item in clsplat.check(finished)["objects"]]
    assert len(files) == len(set(files))


def test_damaged_preparation_note_is_detected(copy):
    (copy / "prepared.json").write_text('{"inputs": "a", "folder": "b"}')
    assert damaged(copy) == {}
    (copy / "prepared.json").write_text("{}")
    assert set(damaged(copy)) == {"prepared.json"}


def test_run_without_a_process_is_reported_as_killed(copy):
    status = json.loads((copy / "status.json").read_text())
    (copy / "status.json").write_text(json.dumps({**status, "state": "running", "process": 2**22 + 1}))
    assert clsplat.check(copy)["state"] == clsplat.status(copy)["state"] == "killed"


def test_suggested_remedy_works(copy):
    (copy / "point_cloud.ply").write_bytes(b"")
    assert f"`clsplat resume {copy}`" in command("check", copy, expect=7).stderr
    for path in (copy / "checkpoints").iterdir():
        path.write_bytes(b"")
    said = command("check", copy, expect=7).stderr
    assert f"`clsplat run {copy}/pipeline.yaml --out {copy} --restart`" in said
    assert "resume" not in said


def test_damaged_checkpoint_is_described_plainly(copy):
    path = copy / "checkpoints" / "step_000020.npz"
    data = bytearray(path.read_bytes())
    path.write_bytes(b"")
    assert damaged(copy)["checkpoints/step_000020.npz"] == "it is empty"
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert damaged(copy)["checkpoints/step_000020.npz"].startswith("it cannot be parsed (")
    said = command("check", copy, expect=7).stderr
    assert "all outputs are intact" in said
    assert "resume" not in said, "it would leave the run as it is"


def test_dry_resume_prints_the_step(copy):
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    assert "up to date" in command("resume", copy, "--dry-run").stdout
    (copy / "report.html").unlink()
    before.pop(copy / "report.html")
    assert "step 20" in command("resume", copy, "--dry-run").stdout
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


def test_missing_path_error_mentions_run_folders():
    assert "expected a pipeline, a model, or a run folder" in command("check", "runs/nosuch", expect=2).stderr


def test_checksums_belong_to_the_last_finished_run(copy):
    (copy / "point_cloud.ply").write_bytes(b"")
    assert damaged(copy)
    (copy / "checkpoints" / "step_000020.npz").unlink()
    clsplat.resume(copy)
    assert damaged(copy) == {}


def test_check_of_a_matrix_includes_its_cells(tiny_scene, tmp_path):
    (tmp_path / "two.yaml").write_text(TINY.format(scene=tiny_scene))
    out = clsplat.run(tmp_path / "two.yaml", out=tmp_path / "run")
    assert damaged(out) == {}
    cell = next(path for path in sorted(out.iterdir()) if path.is_dir())
    (cell / "point_cloud.ply").write_bytes(b"ply")
    assert damaged(out) == {f"{cell.name}/point_cloud.ply": "does not match its checksum"}
    assert "cells" in clsplat.check(tmp_path / "two.yaml")
    assert f"`clsplat resume {cell}`" in command("check", out, expect=7).stderr
    shutil.rmtree(cell)
    (out / "compare.html").unlink()
    result = damaged(out)
    assert {f"{cell.name}/pipeline.yaml", "compare.html"} <= set(result)
    assert f"`clsplat resume {out}`" in command("check", out, expect=7).stderr
    (out / "pipeline.yaml").unlink()
    assert "inputs.json" not in damaged(out), "which is of a run, not of a matrix"


def test_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"has neither pipeline.yaml nor status.json"):
        verify(RunState.read(tmp_path))
    assert "expected a run folder" in command("check", tmp_path, expect=3).stderr


def test_schema_of_a_status_describes_every_key():
    schema = clsplat.status_schema()
    for part in (schema, *schema["$defs"].values()):
        assert [name for name, value in part["properties"].items() if "description" not in value] == []
