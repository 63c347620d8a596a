"""`clsplat status`: the state of local and remote runs, from their files."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clsplat.runs import status as reading
from clsplat.runs.state import RunState
from clsplat.training.status import StageProgress, StatusFile
from tests.support.refusals import refusal
from tests.support.runs import write_status

pytestmark = pytest.mark.slow


def write_and_read_status(folder: Path, **values) -> dict:
    """Write the status of a run whose process has ended; return what `status` reads."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    killed = {"step": 7, "steps": 9, "state": "running", "process": gone.pid, "time": time.time() - 200}
    write_status(folder, **{**killed, **values})
    return reading.run_status(RunState.read(folder))


def test_missing_process_counts_as_killed(tmp_path):
    status = write_and_read_status(tmp_path)
    assert status["state"] == "killed"
    assert "silent" not in status


@pytest.mark.parametrize("elsewhere", [{"host": "another"}, {"pid_namespace": "pid:[1]"}])
def test_remote_run_is_judged_only_by_its_heartbeat(elsewhere, tmp_path):
    status = write_and_read_status(tmp_path, **elsewhere)
    assert status["state"] == "running"
    assert 199 < status["silent"] < 300
    place = f"it runs on {elsewhere.get('host', StatusFile(tmp_path).now.host)}"
    assert f"\n  no heartbeat for {status['silent']} s; {place}" in reading.format_status(status)
    assert "no heartbeat" not in reading.format_status(
        write_and_read_status(tmp_path, time=time.time() - 2, **elsewhere)
    )


def test_stopped_process_has_no_heartbeat(tmp_path):
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        status = write_and_read_status(tmp_path, process=process.pid)
        process.communicate(b"\n")
    assert f"no heartbeat for {status['silent']} s; process {process.pid}" in reading.format_status(status)


def test_status_prints_stage_and_time_left(tmp_path):
    amount = StageProgress(done=3, total=20, unit="views")
    status = write_and_read_status(
        tmp_path, host="a", time=time.time(), stage="evaluate", progress=amount, seconds_left=71.6
    )
    assert reading.format_status(status).splitlines()[0] == (
        f"{tmp_path}: running at step 7 of 9, evaluate, 3 of 20 views, 72 s left"
    )


def test_status_prints_left_out_photographs(tmp_path):
    status = write_and_read_status(tmp_path, state="done", progress=None)
    features, cameras = {"damaged": {"b.jpg": "cut"}}, {"registered": 3, "not_registered": [], "error_px": 0.5}
    status["metrics"] = {"preparation": {"find_features": features, "map_cameras": cameras}}
    text = reading.format_status(status)
    assert "3 of 4 photos registered, reprojection error 0.50 px; left out: b.jpg (cut)" in text


def test_clock_ahead_is_noted_and_gives_no_negative_time(tmp_path):
    status = write_and_read_status(tmp_path, host="a", time=time.time() + 500)
    assert status["silent"] == 0
    assert 490 < status["ahead"] <= 500
    assert f"\n  its machine's clock is {status['ahead']} s ahead; it runs on a; the run may" in reading.format_status(
        status
    )
    status = write_and_read_status(tmp_path, host="a", time=time.time() + 5)
    assert "ahead" not in status
    assert "its clock" not in reading.format_status(status)


@pytest.mark.parametrize("state", ["killed", "failed", "interrupted"])
def test_suggested_command_works(state, tmp_path):
    more = {} if state == "killed" else {"state": state, "message": "stopped at step 7; --resume continues from there"}
    (tmp_path / "pipeline.yaml").touch()
    text = reading.format_status(write_and_read_status(tmp_path, **more))
    assert f"no checkpoint was saved; `clsplat resume {tmp_path}` starts it over" in text
    gone = reading.format_status(write_and_read_status(tmp_path, checkpoint="checkpoints/step_000005.npz", **more))
    assert f"are missing; `clsplat run {tmp_path / 'pipeline.yaml'} --out {tmp_path} --restart` starts" in gone
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "step_000007.npz").touch()
    text = reading.format_status(write_and_read_status(tmp_path, **more))
    assert f"`clsplat resume {tmp_path}` continues it" in text
    assert "--restart" not in text


def test_step_is_the_later_of_status_and_report(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 8, "kind": "train", "loss": 0.1, "psnr": 20}\n')
    assert ": failed at step 8 of 9" in reading.format_status(write_and_read_status(tmp_path, state="failed"))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("time", "1e999"),
        ("time", "NaN"),
        ("time", "9" * 400),
        ("step", "9" * 4000),
        ("cells", "[]"),
        ("host", "{}"),
        ("message", "[1]"),
        ("state", '"x"'),
    ],
)
def test_damaged_status_is_refused(name, value, tmp_path):
    write_and_read_status(tmp_path, host="a")
    path = tmp_path / "status.json"
    status = {**json.loads(path.read_text()), name: "HERE"}
    path.write_text(json.dumps(status).replace('"HERE"', value))
    message = refusal(reading.run_status, RunState.read(tmp_path))
    assert message.startswith(f"{path}: damaged ({name}: ")


def test_status_of_a_newer_version_is_refused(tmp_path):
    write_and_read_status(tmp_path)
    path = tmp_path / "status.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "format": 2}))
    assert "by a newer version" in refusal(reading.run_status, RunState.read(tmp_path))


def test_status_has_no_terminal_escapes(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 8, "kind": "train", "loss": ' + "9" * 4000 + "}\n")
    status = write_and_read_status(tmp_path, host="a", stage="\x1b[2J\x1b[31mhi", silent="x")
    text = reading.format_status(status)
    assert "\x1b" not in text
    assert "[31mhi" in text
    assert max(map(len, text.splitlines())) <= 1010
