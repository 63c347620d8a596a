"""status.json: its schema, its heartbeat, and no effect on the run."""

import gc
import json
import threading
import time
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

import clsplat
from clsplat.core.errors import ClsplatError, OutputError
from clsplat.core.files import write_text
from clsplat.core.resources import full_version
from clsplat.sweeps.experiment import Job
from clsplat.training import status as writing
from clsplat.training.status import StatusFile
from tests.support.runs import FEW, digest, train

pytestmark = pytest.mark.slow

# statuses of this version have no other keys
SCHEMA = Draft202012Validator({**clsplat.status_schema(), "additionalProperties": False})
MATRIX = "name: two\nmatrix:\n  pipelines: [smoke]\n  seeds: [1, 2]\n  steps: 10\n"
SHORT = {key: int(value) for key, value in (setting.split("=") for setting in FEW)}


@pytest.fixture
def written(monkeypatch, tmp_path):
    """Every status of the test's own runs that is written, in order: each one that there is, and fast heartbeats.

    Runs of other modules may still be held, and their hearts beat.
    """
    texts: list[dict] = []
    note = StatusFile.note

    def note_and_write(status: StatusFile, **values) -> None:
        note(status, **values)
        status.refresh()

    def write(path: Path, text: str) -> None:
        if path.is_relative_to(tmp_path):
            texts.append(json.loads(text))
        write_text(path, text)

    monkeypatch.setattr(writing, "write_text", write)
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 0.002)
    monkeypatch.setattr(StatusFile, "note", note_and_write)
    return texts


def until(holds) -> None:
    """Wait for a condition that another thread fulfills."""
    for _ in range(2000):
        if holds():
            return
        time.sleep(0.01)
    pytest.fail("it did not happen")


def in_order(items: list) -> list:
    return [item for i, item in enumerate(items) if i == 0 or item != items[i - 1]]


def test_every_status_of_a_run_fits_the_schema(written, tiny_scene, tmp_path):
    clsplat.run("smoke", tiny_scene, tmp_path / "run", set=SHORT)
    for status in written:
        SCHEMA.validate(status)
    assert in_order([status["state"] for status in written]) == ["starting", "preparing", "running", "done"]
    stages = in_order([status.get("stage") for status in written])
    assert stages[0] is None
    assert {"init", "optimize", "densify", "checkpoint", "evaluate", "export", "render", "report"} <= set(stages)
    training = [s["progress"] for s in written if s.get("stage") == "optimize" and s.get("progress")]
    assert [amount["done"] for amount in training] == sorted(amount["done"] for amount in training)
    assert {(amount["total"], amount["unit"]) for amount in training} == {(12, "steps")}
    last = written[-1]
    assert (last["exit_code"], last["step"], last["steps"], last["stage"]) == (0, 12, 12, "report")
    assert last["device"]
    assert last["version"] == full_version()
    assert "seconds_left" not in last


@pytest.mark.parametrize(
    ("failure", "state", "code"), [(OutputError("no space"), "failed", 7), (KeyboardInterrupt(), "interrupted", 130)]
)
def test_early_end_names_the_stage_and_fits_the_schema(
    failure, state, code, written, tiny_scene, tmp_path, monkeypatch
):
    def fail(*arguments, **settings):
        raise failure

    monkeypatch.setattr("clsplat.stages.evaluate.measure", fail)
    with pytest.raises(ClsplatError):
        clsplat.run("smoke", tiny_scene, tmp_path / "run", set=SHORT)
    for status in written:
        SCHEMA.validate(status)
    last = written[-1]
    assert (last["state"], last["exit_code"], last["stage"]) == (state, code, "evaluate")
    assert last["message"]
    assert last["step"] > 0


def test_every_status_of_a_matrix_fits_the_schema(written, tiny_scene, tmp_path):
    file = tmp_path / "two.yaml"
    file.write_text(MATRIX)
    Job.open(str(file), tiny_scene, tmp_path / "out").run()
    for status in written:
        SCHEMA.validate(status)
    whole = [status for status in written if "cells" in status]
    assert in_order([status["state"] for status in whole]) == ["starting", "running", "done"]
    assert in_order([status["done"] for status in whole]) == [0, 1, 2]
    assert len({status.get("stage") for status in whole} - {None}) == 2, "the names of the cells"
    assert whole[-1]["progress"] == {"done": 2, "total": 2, "unit": "cells"}


def test_steps_of_the_preparation_are_stages(written, tmp_path):
    from clsplat.prepare.cache import PlannedStep, prepare
    from clsplat.prepare.steps import Step

    class Wait(Step):
        def make(self, source: Path, out: Path, without: Path) -> dict:
            seen = len(written)
            until(lambda: len(written) > seen + 1)
            return {}

    status = StatusFile(tmp_path)
    status.begin()
    status.enter("preparing")
    planned = [PlannedStep(Wait(stage="wait"), "", "", tmp_path / "prepared" / "wait", "no result yet")]
    prepare(planned, tmp_path, tmp_path / "prepared", status.stage)
    status.end("done", 0)
    assert ("preparing", "wait") in {(item["state"], item.get("stage")) for item in written}


def test_heartbeat_continues_during_long_work(written, tmp_path):
    status = StatusFile(tmp_path)
    status.begin()
    until(lambda: len(written) > 3)
    times = [item["time"] for item in written]
    assert times == sorted(set(times))
    assert len({item["changed"] for item in written}) == 1
    status.end("done", 0)


def test_nothing_is_written_after_the_end(tmp_path, monkeypatch):
    """A heartbeat that is being written when a run ends does not stay."""
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 0.001)
    waiting, go_on = threading.Event(), threading.Event()
    main = threading.current_thread()

    def write(path: Path, text: str) -> None:
        if threading.current_thread() is not main:
            waiting.set()
            go_on.wait(20)
        write_text(path, text)

    monkeypatch.setattr(writing, "write_text", write)
    status = StatusFile(tmp_path)
    status.begin()
    assert waiting.wait(20)
    threading.Timer(0.05, go_on.set).start()
    status.end("failed", 3, "no")
    until(lambda: not status._thread.is_alive())
    assert json.loads((tmp_path / "status.json").read_text())["state"] == "failed"


def test_full_disk_does_not_stop_a_run(tiny_scene, tmp_path, monkeypatch, caplog):
    def write(path: Path, text: str) -> None:
        if json.loads(text)["state"] in ("preparing", "running"):
            raise OutputError(f"{path}: cannot be written (No space left on device)")
        write_text(path, text)

    monkeypatch.setattr(writing, "write_text", write)
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 0.002)
    clsplat.run("smoke", tiny_scene, tmp_path / "run", set=SHORT)
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "done"
    name = tmp_path / "run" / "status.json"
    assert [m for m in caplog.messages if str(name) in m] == [
        f"{name}: cannot be written (No space left on device); the run continues"
    ]


def test_heartbeat_changes_no_bits(tiny_scene, tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 1000.0)
    train(tiny_scene, tmp_path / "slow", *FEW)
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 0.0005)
    train(tiny_scene, tmp_path / "fast", *FEW)
    assert digest(tmp_path / "slow") == digest(tmp_path / "fast")


def test_removed_folder_is_not_recreated(written, tmp_path):
    status = StatusFile(tmp_path / "run")
    status.begin()
    (tmp_path / "gone").mkdir()
    (tmp_path / "run").rename(tmp_path / "gone" / "run")
    seen = len(written)
    status.refresh()
    assert len(written) <= seen + 1  # one may have been on its way
    assert not (tmp_path / "run").exists()
    status._ended.set()


def test_unlocked_run_has_no_heartbeat(written, tmp_path):
    status = StatusFile(tmp_path)
    status.begin()
    thread = status._thread
    del status
    gc.collect()
    until(lambda: not thread.is_alive())
