"""A refused run leaves no files; --restart starts over and keeps foreign files."""

import json

import pytest

import clsplat
from clsplat.core.errors import ConfigError
from clsplat.sweeps import experiment
from tests.support.commands import clsplat as command
from tests.support.commands import ran

pytestmark = pytest.mark.slow


def test_refused_run_leaves_no_folder(tiny_scene, tmp_path):
    damaged = tmp_path / "damaged.ply"
    damaged.write_text("ply")
    for name, arguments in {
        "a/b": ["smoke", "--scene", tmp_path / "nowhere"],
        "c": ["smoke", "--scene", tiny_scene, "--device", "no such device"],
        "d": ["smoke", "--scene", tiny_scene, "--set", "evaluate.lpips=nowhere.onnx"],
        "e": ["smoke", "--scene", tiny_scene, "--set", "init.source=random", "init.count=50000000"],
        "f": ["smoke", "--scene", tiny_scene, "--set", "init.source=model", f"init.file={damaged}"],
        "g": ["smoke", "--scene", tiny_scene, "--set", "init.source=model"],
    }.items():
        out = tmp_path / name
        words = ["run", *arguments, "--out", out]
        done = ran(*words)
        assert "Traceback" not in done.stderr
        assert done.returncode in (2, 3, 4, 5), done.stderr
        assert not (tmp_path / name.split("/")[0]).exists(), name
        described = ran(*words, "--dry-run")
        assert (described.returncode, described.stderr) == (done.returncode, done.stderr)
        if name not in ("a/b", "f"):  # before the device is opened, and after
            continue
        out.mkdir(parents=True)
        again = ran(*words)
        assert again.returncode == done.returncode
        status = json.loads((out / "status.json").read_text())
        assert (status["state"], status["exit_code"]) == ("failed", done.returncode)
        assert f"error: {status['message']}" in again.stderr
        assert {path.name for path in out.iterdir()} == {"status.json", "log.txt"}, "the corrected command can begin"


def test_folder_with_foreign_files_is_not_removed(tiny_scene, tmp_path, monkeypatch):
    def open_run(pipeline, out, *others):
        (out / "notes.txt").write_text("mine")
        raise ConfigError("refused")

    monkeypatch.setattr(experiment.opening, "open_run", open_run)
    with pytest.raises(ConfigError, match="refused"):
        clsplat.run("smoke", tiny_scene, tmp_path / "run")
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "failed"


def test_restart_keeps_foreign_files(tiny_scene, tmp_path):
    out = tmp_path / "run"
    arguments = ["run", "smoke", "--scene", tiny_scene, "--out", out, "--set", "optimize.steps=20", "init.count=100"]
    command(*arguments)
    (out / "notes.txt").write_text("mine")
    (out / "checkpoints" / "failed_000003.npz").write_text("x")
    assert "already has a run; use another folder, --resume, or --restart" in command(*arguments, expect=2).stderr
    assert "use only one of them" in command(*arguments, "--resume", "--restart", expect=2).stderr
    model = (out / "point_cloud.ply").read_bytes()
    records = (out / "metrics.jsonl").read_text()
    refused = command(*arguments, "seed=2", "--restart", "--set", "evaluate.lpips=nowhere.onnx", expect=3)
    assert "nowhere.onnx" in refused.stderr
    assert (out / "metrics.jsonl").read_text() == records, "a refused restart removes nothing"
    command(*arguments, "seed=2", "--restart")
    assert (out / "point_cloud.ply").read_bytes() != model
    assert (out / "notes.txt").read_text() == "mine"
    assert sorted(path.name for path in (out / "checkpoints").iterdir()) == ["step_000010.npz", "step_000020.npz"]
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert len([line for line in lines if line["kind"] == "train"]) == 2
    for file in (out / "checkpoints").iterdir():
        file.write_bytes(b"")
    (out / "report.html").unlink()
    broken = command("resume", out, expect=7)
    assert "and so are all other checkpoints" in broken.stderr
    advice = broken.stderr.split("`")[1].split()
    assert advice[0] == "clsplat"
    command(*advice[1:])
    assert clsplat.status(out)["state"] == "done"
