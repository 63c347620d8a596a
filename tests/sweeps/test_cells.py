"""Cells: keys, running and publishing once, cancellation, and cleanup."""

import errno
import json
import os
import shutil
import sys
import threading
import time
from dataclasses import replace

import pytest

from clsplat.core.errors import ConfigError, DeviceError, Interrupted, OutputError
from clsplat.core.files import CHECKPOINTS
from clsplat.pipeline.loading import load
from clsplat.runs.opening import undistorted_folder
from clsplat.sweeps import child
from clsplat.sweeps.batch import copy_result
from clsplat.sweeps.cell import Scenes
from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.engines import CellLost, Dispatcher, InlineEngine, PendingCell
from clsplat.sweeps.status import format_store_status, store_status
from clsplat.sweeps.store import ATTEMPTS, LEASE, MANIFEST, BitsMismatch, CellAttempt, Store
from clsplat.sweeps.task import CellOptions, Outcome, run_cell
from tests.support.cells import CELL, SPEC, WRITES, Fake, command, keys, pending_cells

WAITS = "import os, sys\nwhile os.read(0, 9): pass\nsys.exit(130)"


UNDISTORTS = """
import sys, pathlib
shared = pathlib.Path(sys.argv[2]).parent / "undistorted" / "a.png"
made = "was there" if shared.exists() else "made"
shared.write_bytes(b"pixels")
pathlib.Path(sys.argv[2], "point_cloud.ply").write_text("bits")
pathlib.Path(sys.argv[2], "told.txt").write_text(made)
"""


def event_names(store: Store) -> list[str]:
    return [event["event"] for event in store.events()]


def test_key_has_no_paths_and_all_inputs_that_change_bits(tiny_scene, tmp_path):
    moved, notes = tmp_path / "moved", tmp_path / "notes"
    shutil.copytree(tiny_scene, moved)
    key = keys("smoke", tiny_scene, notes)
    assert keys("smoke", moved, notes) == key
    assert keys("smoke", moved, notes, "seed=1") != key
    (tmp_path / "a.txt").write_text("train/r_000\n")
    (tmp_path / "b.txt").write_text("train/r_000\n")
    named = [keys("smoke", tiny_scene, notes, f"scene.holdout={{file: '{tmp_path / name}.txt'}}") for name in "ab"]
    assert named[0] == named[1] != key
    (tmp_path / "b.txt").write_text("train/r_001\n")
    assert keys("smoke", tiny_scene, notes, f"scene.holdout={{file: '{tmp_path / 'b'}.txt'}}") != named[0]
    image = next(iter(sorted(moved.rglob("*.png"))))
    image.write_bytes(image.read_bytes() + b"\0")
    assert keys("smoke", moved, notes) != key, "a photo has changed"


def test_fingerprint_matches_the_runs_record_of_its_scene(few_steps, tiny_scene, tmp_path):
    checked = load("smoke", [f"scene.path={tiny_scene}"])
    expected = json.loads((few_steps / "inputs.json").read_text())["digest"]
    assert Scenes(tmp_path).facts(checked).digest == expected


def test_cell_is_published_once_and_then_skipped(store, options):
    first = run_cell(CELL, store, command(WRITES), options)
    assert first.state == "published"
    result = store.folder(CELL.key).result
    assert (result / "point_cloud.ply").read_bytes() == b"bits"
    assert not (result / LEASE).exists()
    assert json.loads((result / MANIFEST).read_text())["bits"] == first.bits
    assert run_cell(CELL, store, command("raise SystemExit(1)"), options) == first
    assert event_names(store) == ["start", "end", "publish", "skip"]
    assert json.loads((store.folder(CELL.key).path / "spec.json").read_text()) == SPEC


def test_damaged_result_is_run_again(store, options):
    run_cell(CELL, store, command(WRITES), options)
    (store.folder(CELL.key).result / "point_cloud.ply").write_bytes(b"bitz")
    assert run_cell(CELL, store, command(WRITES), options).state == "published"
    assert (store.folder(CELL.key).result / "point_cloud.ply").read_bytes() == b"bits"
    assert event_names(store).count("publish") == 2


@pytest.mark.parametrize(("bits", "state"), [(b"bits", "published"), (b"others", "different")])
def test_first_of_two_writers_publishes_and_the_second_compares(store, options, bits, state):
    folder = store.add(CELL)
    first = folder.begin("a", options.since)
    (first.path / "point_cloud.ply").write_bytes(b"bits")
    code = (
        WRITES.replace("b'bits'", repr(bits)) + f"; import os; os.rename({str(first.path)!r}, {str(folder.result)!r})"
    )
    first.write_manifest()
    outcome = run_cell(CELL, store, command(code), options)
    assert outcome.state == state
    assert (folder.result / "point_cloud.ply").read_bytes() == b"bits"
    if state == "published":
        assert event_names(store)[-1] == "second"
    else:
        assert "gave different bits" in outcome.message
        drive = Dispatcher(store, Fake(outcome), True, options)
        with pytest.raises(BitsMismatch, match="gave different bits"):
            drive.run([PendingCell(CELL, 1)])


@pytest.mark.parametrize(
    ("code", "starts"), [(2, 1), (3, 1), (5, 1), (1, 3), (4, 3), (6, 3), (7, 3), (130, 0), (-9, 3)], ids=str
)
def test_exit_code_decides_whether_a_cell_is_retried(store, options, code, starts):
    end = f"import os, sys; sys.stderr.write('error: as it is\\n'); sys.stderr.flush(); os._exit({code})"
    if code == -9:
        end = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
    if code == 130:  # from elsewhere: another attempt goes on, and ends
        end = "import sys, pathlib; p = pathlib.Path(sys.argv[2]);"
        end += "n = sum(not one.is_symlink() for one in p.parent.iterdir()); sys.exit(130 if n == 1 else 0)"
    outcome = run_cell(CELL, store, command(end), options)
    if code == 130:
        assert (outcome.state, event_names(store).count("start")) == ("published", 2)
        return
    assert (outcome.state, event_names(store).count("start")) == ("failed", starts)
    assert outcome.exit_code == (code if code > 0 else 1)
    assert outcome.message == ("as it is" if code > 0 else "its process ended with signal 9")
    failed = json.loads((store.folder(CELL.key).path / "failed.json").read_text())
    assert (failed["exit_code"], failed["exit_codes"]) == (outcome.exit_code, [code] * starts)
    again = replace(options, since=store.now() + 1)
    assert run_cell(CELL, store, command(WRITES), again).state == "published", "a later sweep tries it again"
    assert not (store.folder(CELL.key).path / "failed.json").exists()


@pytest.mark.parametrize("times", [1, 9])
def test_unwritable_result_counts_as_a_failure(store, options, monkeypatch, times):
    faults = [OSError(errno.ENOSPC, "No space left on device")] * times

    def sync(path):
        if faults:
            raise faults.pop()

    monkeypatch.setattr("clsplat.sweeps.store.sync_below", sync)
    outcome = run_cell(CELL, store, command(WRITES), options)
    if times == 1:
        assert (outcome.state, event_names(store).count("start")) == ("published", 2)
        return
    assert (outcome.state, outcome.exit_code, event_names(store).count("start")) == ("failed", 7, 3)
    assert "cannot be written (No space left on device)" in outcome.message
    assert store.folder(CELL.key).failure()["exit_codes"] == [7] * 3


def test_failure_after_a_newer_checkpoint_does_not_count(few_steps, store, options):
    saves = "import sys, pathlib, shutil, os; p = pathlib.Path(sys.argv[2], 'checkpoints'); p.mkdir(exist_ok=True)\n"
    saves += f"left = sorted(pathlib.Path({str(few_steps / CHECKPOINTS)!r}).iterdir())\n"
    saves += "new = [one for one in left if not (p / one.name).exists()]\n"
    saves += "new and shutil.copy(new[0], p)\nos._exit(7)"
    count = len(list((few_steps / CHECKPOINTS).iterdir()))
    assert count > 1
    assert run_cell(CELL, store, command(saves), replace(options, retries=2)).state == "failed"
    assert event_names(store).count("start") == count + 2


def test_failure_with_a_newer_damaged_checkpoint_counts(few_steps, store, options):
    old = CellAttempt(store.add(CELL).path / ATTEMPTS / ("a" * 32))
    shutil.copytree(few_steps, old.path)
    newest = max((old.path / CHECKPOINTS).glob("step_*.npz"))
    newest.write_bytes(newest.read_bytes()[:-100])
    starts = "import os, sys; sys.exit(2 if len(os.listdir(os.path.dirname(sys.argv[2]))) > 6 else 6)"
    assert run_cell(CELL, store, command(starts), options).exit_code == 6
    assert event_names(store).count("start") == options.retries


@pytest.mark.parametrize("damage", ["cut", "flipped"])
def test_attempt_resumes_from_the_newest_intact_checkpoint(few_steps, store, options, damage):
    folder = store.add(CELL)
    old = CellAttempt(folder.path / ATTEMPTS / ("a" * 32))
    shutil.copytree(few_steps, old.path)
    (old.path / "run.lock").write_text("{}")
    *_, before, newest = sorted((old.path / CHECKPOINTS).glob("step_*.npz"))
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 1
    newest.write_bytes(data if damage == "flipped" else data[:-100])
    new = folder.begin("b", options.since)
    assert [path.name for path in (new.path / CHECKPOINTS).iterdir()] == [before.name]
    assert new.lease["from"] == before.name
    assert not (new.path / "status.json").exists()
    assert not (new.path / "run.lock").exists()
    assert os.path.samefile(before, new.path / CHECKPOINTS / before.name)
    assert not os.path.samefile(old.path / "metrics.jsonl", new.path / "metrics.jsonl"), "a run appends to it"


def test_cancelled_cell_saves_and_stops_and_a_later_call_resumes(store, options):
    threading.Timer(0.3, store.cancel).start()
    outcome = run_cell(CELL, store, command(WAITS), options)
    assert (outcome.state, outcome.exit_code) == ("stopped", 130)
    assert store_status(store.root)["cells"][0]["state"] == "stopped"
    assert run_cell(CELL, store, command(WRITES), options).state == "stopped", "it began before"
    time.sleep(0.02)
    assert run_cell(CELL, store, command(WRITES), CellOptions(store.now())).state == "published"


def test_cell_is_cancelled_by_name_or_key_prefix(store, options):
    other = replace(CELL, spec={**SPEC, "scene": "t"})
    store.add(CELL)
    store.add(other)
    store.note_sweep("sweep", {"first": CELL.key}, "")
    assert store.cancel("first") == CELL.key == store.cancel(CELL.key[:12])
    assert store.is_cancelled([CELL.key], options.since)
    assert not store.is_cancelled([other.key], options.since)
    with pytest.raises(ConfigError, match="no cell 'x'"):
        store.cancel("x")


def test_matrices_of_equal_name_keep_their_cells(store, options):
    changed = replace(CELL, spec={**SPEC, "scene": "t"})
    for cell in (CELL, changed):
        store.add(cell)
        store.note_sweep("sweep", {"first": cell.key}, cell.key)
    assert {cell["name"] for cell in store_status(store.root)["cells"]} == {"first"}
    with pytest.raises(ConfigError, match="'first' matches 2 cells; give a key"):
        store.cancel("first")
    run_cell(CELL, store, command(WRITES), options)
    assert store.cancel("first") == changed.key


def test_run_that_ignores_its_stop_is_killed(store, options, monkeypatch):
    monkeypatch.setattr(child, "STOP_TIMEOUT_S", 0.1)
    deaf = "import time\ntime.sleep(60)"
    began = time.monotonic()
    assert run_cell(CELL, store, command(deaf), options, lambda: time.monotonic() > began + 0.3).state == "stopped"
    assert store.folder(CELL.key).attempts()[0].exit_code == -9


def test_removed_attempt_ends_its_run(store, options, monkeypatch):
    monkeypatch.setattr("clsplat.sweeps.store.BEAT_INTERVAL_S", 0.0)
    removes = "import shutil, sys, time; shutil.rmtree(sys.argv[2]); time.sleep(60)"
    outcome = run_cell(CELL, store, command(removes), options)
    assert outcome.state == "failed"
    assert "was removed during its run" in outcome.message


def test_process_frozen_past_its_attempt_uses_the_result(store, options, monkeypatch):
    monkeypatch.setattr("clsplat.sweeps.store.BEAT_INTERVAL_S", 0.0)
    folder = store.add(CELL)
    other = folder.begin("other", options.since)
    (other.path / "point_cloud.ply").write_bytes(b"bits")
    publishes = f"import os, shutil, sys, time; os.rename({str(other.path)!r}, {str(folder.result)!r})\n"
    other.write_manifest()
    outcome = run_cell(CELL, store, command(publishes + "shutil.rmtree(sys.argv[2]); time.sleep(60)"), options)
    assert outcome.state == "published"
    assert event_names(store) == ["start", "skip"]


def test_process_frozen_after_its_run_uses_the_result(store, options, monkeypatch):
    folder = store.add(CELL)
    other = folder.begin("other", options.since)
    (other.path / "point_cloud.ply").write_bytes(b"bits")
    other.write_manifest()

    def sleeps(cell, attempt):
        os.rename(other.path, folder.result)
        shutil.rmtree(attempt.path)

    monkeypatch.setattr("clsplat.sweeps.task._require_same_scene", sleeps)
    outcome = run_cell(CELL, store, command(WRITES), options)
    assert (outcome.state, outcome.message) == ("published", "")
    assert event_names(store) == ["start", "end", "skip"]
    assert not folder.attempts()


def test_copied_result_gets_its_manifest_last(store, options, tmp_path, monkeypatch):
    run_cell(CELL, store, command(WRITES), options)
    result, copied = store.folder(CELL.key).result, []
    for name in "abcdefgh":
        (result / name).touch()
    for module in ("store", "batch"):
        monkeypatch.setattr(f"clsplat.sweeps.{module}.link_or_copy", lambda _, target: copied.append(target.name))
    copy_result(result, tmp_path / "copy")
    assert copied[-1] == MANIFEST != copied[-2]


def test_attempts_are_removed_only_by_lease_age(store, options):
    folder = store.add(CELL)
    old, young = folder.begin("a", options.since), folder.begin("b", options.since)
    folder.clean_up(store.now() + 1e6)
    assert old.path.is_dir(), "nothing is published"
    os.utime(old.path / LEASE, (store.now() - 601, store.now() - 601))
    run_cell(CELL, store, command(WRITES), options)
    assert not old.path.exists()
    assert young.path.is_dir()
    os.utime(young.path / LEASE, (store.now() - 601, store.now() - 601))
    run_cell(CELL, store, command(WRITES), options)
    assert not young.path.exists(), "the next call finds the result, and that"


def test_damaged_spec_is_rewritten(store, options):
    folder = store.add(CELL)
    (folder.path / "spec.json").write_text('{"pipe')
    assert run_cell(CELL, store, command(WRITES), options).state == "published"
    assert json.loads((folder.path / "spec.json").read_text()) == SPEC


def test_spec_is_never_changed(store):
    folder = store.add(CELL)
    with pytest.raises(OutputError, match="belongs to another cell"):
        folder.write_spec({**SPEC, "seed": 1})


def test_moved_store_can_be_resumed(few_steps, store, options, tmp_path):
    folder = store.add(CELL)
    shutil.copytree(few_steps / CHECKPOINTS, folder.begin("a", options.since).path / CHECKPOINTS)
    moved = Store(tmp_path / "moved")
    store.root.rename(moved.root)
    assert moved.add(CELL).begin("b", options.since).lease["from"] == "step_000012.npz"


def test_undistorted_photographs_are_shared_by_cells_of_a_scene(store, options):
    cells = [CELL, replace(CELL, spec={**SPEC, "seed": 1}), replace(CELL, spec={**SPEC, "scene": "another"})]
    assert {run_cell(cell, store, command(UNDISTORTS), options).state for cell in cells} == {"published"}
    results = [store.folder(cell.key).result for cell in cells]
    assert [(result / "told.txt").read_text() for result in results] == ["made", "was there", "made"]
    assert len([*store.root.glob("undistorted/*/a.png")]) == 2
    attempt = store.folder(CELL.key).path / ATTEMPTS / "a"
    assert undistorted_folder(attempt).parent.resolve().parent == store.root / "undistorted"
    assert undistorted_folder(store.root / "run") == store.root / "run" / "undistorted", "that is no link"


def test_longest_cell_is_first_and_a_lost_one_restarts(store, options):
    done = Outcome("published")
    engine = Fake(CellLost, done, done, done)
    ended = []
    Dispatcher(store, engine, True, options, on_end=lambda cell, outcome: ended.append(cell.name)).run(
        pending_cells(1, 3, 2)
    )
    assert [name for name, *_ in engine.started] == ["3", "3", "2", "1"]
    assert ended == ["3", "2", "1"]


SLOTS = (DeviceSlot("w", "one", "x"), DeviceSlot("w", "two", "y"), DeviceSlot("w", "three", "y"))


def test_sweep_stays_in_the_bits_class_of_most_devices(store, options):
    engine = Fake(*[Outcome("published")] * 3, slots=SLOTS)
    Dispatcher(store, engine, True, options).run(pending_cells(1, 2, 3))
    assert {bits for *_, bits in engine.started} == {"y"}


def test_cell_stays_in_the_class_it_started_in(store, options):
    (first,) = pending_cells(9)
    store.add(first.in_class("x"))
    engine = Fake(*[Outcome("published")] * 4, slots=SLOTS)
    Dispatcher(store, engine, False, options).run([first, *pending_cells(1, 2, 3)])
    assert engine.started[0] == ("9", "one", "x")
    assert {bits for *_, bits in engine.started[1:]} == {"x", "y"}


@pytest.mark.parametrize("published", ["x", "y", None])
def test_class_with_most_results_breaks_ties(store, options, published):
    for item in pending_cells(1, 2) if published else []:
        run_cell(item.in_class(published), store, command(WRITES), options)
    engine = Fake(*[Outcome("published")] * 3, slots=SLOTS[1::-1])
    Dispatcher(store, engine, True, options).run(pending_cells(1, 2, 3))
    assert {bits for *_, bits in engine.started} == {published or "x"}


def test_sweep_whose_class_has_no_device_left_names_the_others(store, options, monkeypatch):
    monkeypatch.setattr("clsplat.sweeps.engines.NO_DEVICE_TIMEOUT_S", 0.2)
    drive = Dispatcher(store, Fake(slots=SLOTS), True, options, bits="z")
    looks = iter(range(40))
    drive.is_stopped = lambda: next(looks) == 39
    with pytest.raises(DeviceError, match=r"no device of bits class z for .* of x, y; offer a device of that class"):
        drive.run(pending_cells(1))


def test_running_cells_do_not_rescan_waiting_ones(store, options, monkeypatch):
    looks = []
    suits = Dispatcher._fits
    monkeypatch.setattr(Dispatcher, "_fits", lambda *values: looks.append(1) or suits(*values))
    engine = Fake()

    def start(*values):
        ends = [None, None, Outcome("published")]
        return type("Ticket", (), {"outcome": lambda self: ends.pop(0)})()

    engine.start = start
    Dispatcher(store, engine, False, options).run(pending_cells(*range(5)))
    assert len(looks) == 5


def test_device_that_suits_no_cell_is_checked_once(store, options, monkeypatch):
    looks = []
    suits = Dispatcher._fits
    monkeypatch.setattr(
        Dispatcher, "_fits", lambda drive, one, slot, _: looks.append(slot.bits) or suits(drive, one, slot, _)
    )
    monkeypatch.setattr("clsplat.sweeps.engines.POLL_INTERVAL_S", 0.0)
    engine, begun = Fake(slots=SLOTS[:2]), pending_cells(*range(5))
    for one in begun:
        store.add(one.in_class("x"))

    def start(*values):
        ends = [*[None] * 9, Outcome("published")]
        return type("Ticket", (), {"outcome": lambda self: ends.pop(0)})()

    engine.start = start
    Dispatcher(store, engine, False, options).run(begun)
    assert looks.count("y") == 4, "one look at each cell that waits"


def test_signal_stops_a_sweep(store, options):
    with pytest.raises(Interrupted, match="and --resume"):
        Dispatcher(store, Fake(), True, options, is_stopped=lambda: True).run(pending_cells(1))


def test_inline_engine_runs_a_cell(store, options, monkeypatch):
    monkeypatch.setattr("clsplat.sweeps.engines.run_command", lambda device, plugins: command(WRITES))
    engine = InlineEngine(store, SLOTS[0], lambda: False)
    ticket = engine.start(CELL, SLOTS[0], options)
    assert ticket.outcome().state == "published"


def test_store_state_is_read_from_files(store, options):
    cells = [replace(CELL, name=name, spec={**SPEC, "scene": name}) for name in ("done", "bad", "on", "new")]
    run_cell(cells[0], store, command(WRITES), options)
    run_cell(cells[1], store, command("raise SystemExit(2)"), options)
    store.add(cells[2]).begin("w", options.since)
    store.add(cells[3])
    store.note_sweep("sweep", {cell.name: cell.key for cell in cells}, "")
    result = store_status(store.root)
    assert {cell["name"]: cell["state"] for cell in result["cells"]} == {
        "done": "published",
        "bad": "failed",
        "on": "running",
        "new": "waiting",
    }
    text = format_store_status(result)
    store.folder(cells[1].key).begin("w", options.since)
    assert store_status(store.root)["counts"] == {"published": 1, "running": 2, "waiting": 1}, "it is tried again"
    store.folder(cells[1].key).give_up(2, "of another process, which has tried it too")
    assert store_status(store.root)["counts"] == {"published": 1, "running": 2, "waiting": 1}, "it runs still"
    assert "1 failed, 1 published, 1 running, 1 waiting" in text
    assert "bad: its process ended with exit code 2" in text
    assert sys.executable not in text
