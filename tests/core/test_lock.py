"""One process at a time in a run folder; the lock is never left behind."""

import errno
import json
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import clsplat
from clsplat.core import lock
from clsplat.core import lock as holder_file
from clsplat.core.errors import OutputError
from clsplat.core.files import LOCK
from clsplat.core.machine import Owner
from clsplat.runs import run_folder
from clsplat.runs.run_folder import find_free_folder
from clsplat.runs.state import RunState
from clsplat.training import status as writing
from tests.support.commands import clsplat as command
from tests.support.runs import ONE_CORE

pytestmark = pytest.mark.slow
NONE = 99999999  # no process has this number


def holder(folder: Path) -> subprocess.Popen:
    """A process that holds a folder until it is killed."""
    code = (
        "import sys, time; from pathlib import Path; from clsplat.core import lock\n"
        "with lock.lock_folder(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def test_another_process_is_refused_and_learns_the_owner(tmp_path):
    process = holder(tmp_path)
    try:
        with pytest.raises(OutputError, match="is in use by process") as refused, lock.lock_folder(tmp_path):
            pass
        assert f"process {process.pid} on " in str(refused.value)
        assert "since 2" in str(refused.value)
        assert refused.value.exit_code == 7
    finally:
        process.kill()
        process.wait()


def test_lock_ends_with_its_process(tmp_path):
    for end in (subprocess.Popen.kill, subprocess.Popen.terminate):
        process = holder(tmp_path)
        end(process)
        process.wait()
        assert (tmp_path / LOCK).exists()
        with lock.lock_folder(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
        assert not (tmp_path / LOCK).exists()


def test_children_do_not_hold_the_lock_of_a_killed_parent(tmp_path):
    code = (
        "import subprocess, sys, time; from pathlib import Path; from clsplat.core import lock\n"
        "with lock.lock_folder(Path(sys.argv[1])):\n"
        "    child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "    print(child.pid, flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    child = int(process.stdout.readline())
    try:
        process.kill()
        process.wait()
        with lock.lock_folder(tmp_path):
            pass
    finally:
        os.kill(child, getattr(signal, "SIGKILL", signal.SIGTERM))


def test_process_locks_a_folder_once_under_any_name(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to("a")
    with lock.lock_folder(tmp_path / "a"):
        for folder in (tmp_path / "a", tmp_path / "b", tmp_path / "a" / ".." / "a"):
            with pytest.raises(OutputError, match="is in use by this process"), lock.lock_folder(folder):
                pass
    with lock.lock_folder(tmp_path / "b"):
        pass


NO_LOCKS = """
import errno, fcntl, logging
def no_locks(*arguments):
    raise OSError(errno.ENOLCK, "no locks")
fcntl.flock = no_locks
logging.disable()
"""


no_windows = pytest.mark.skipif(sys.platform == "win32", reason="has no fcntl to change")


@pytest.mark.parametrize(
    "before", [pytest.param("", id="with locks"), pytest.param(NO_LOCKS, id="without", marks=no_windows)]
)
def test_one_of_many_concurrent_processes_gets_the_folder(before, tmp_path):
    code = before + (
        "import sys, time; from pathlib import Path; from clsplat.core import lock\n"
        "from clsplat.core.errors import OutputError\n"
        "folder, n = Path(sys.argv[1]), 0\n"
        "for _ in range(60):\n"
        "    try:\n"
        "        with lock.lock_folder(folder):\n"
        "            (folder / 'inside').mkdir(); time.sleep(0.001); (folder / 'inside').rmdir(); n += 1\n"
        "    except OutputError: time.sleep(0.001)\n"
        "print(n)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    ends = [process.communicate(timeout=120) for process in processes]
    assert [errors for _, errors in ends] == [""] * 4, "never two inside at once"
    assert sum(int(out) for out, _ in ends) > 0


def test_removed_lock_file_is_no_lock(tmp_path, monkeypatch):
    system_lock, calls = lock._system_lock, []

    def late(file):
        calls.append(file)
        if len(calls) == 1:
            (tmp_path / LOCK).unlink()
        return system_lock(file)

    monkeypatch.setattr(lock, "_system_lock", late)
    with lock.lock_folder(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()


def test_second_run_in_a_folder_is_refused(tiny_scene, tmp_path):
    """With and without --resume; the first run is not disturbed."""
    out = tmp_path / "run"
    arguments = ["run", "smoke", "--scene", str(tiny_scene), "--out", str(out), "--set", "optimize.steps=1000000"]
    slow = {**os.environ, **ONE_CORE}
    process = subprocess.Popen([sys.executable, "-m", "clsplat", *arguments], stdout=subprocess.DEVNULL, env=slow)
    try:
        while not (out / "metrics.jsonl").exists() or not (out / "metrics.jsonl").read_text():
            assert process.poll() is None
            time.sleep(0.05)
        status = json.loads((out / "status.json").read_text())
        assert f"{out}: already has a run; " in command(*arguments, expect=2).stderr
        for more in ("--resume", "--restart"):
            refused = command(*arguments, more, expect=7)
            assert f"{out}: is in use by process {process.pid} on " in refused.stderr
            assert command(*arguments, more, "--dry-run", expect=7).stderr == refused.stderr
        refused = command("resume", out, expect=7)
        assert "(__main__.py run smoke" in refused.stderr or "(clsplat run smoke" in refused.stderr
        assert json.loads((out / "status.json").read_text())["process"] == status["process"] == process.pid
        command("status", out)
    finally:
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 130
    assert not (out / LOCK).exists()
    steps = [json.loads(line)["step"] for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert steps == sorted(steps)


def test_trainers_hold_their_folder_until_they_end(tiny_scene, tmp_path):
    few = {"optimize.steps": 3}
    first = clsplat.Trainer(tiny_scene, "smoke", set=few, out=tmp_path / "run")
    first.step()
    first.checkpoint()
    with pytest.raises(OutputError, match="is in use by this process; close the run or trainer that uses it"):
        clsplat.Trainer(tiny_scene, "smoke", set=few, out=tmp_path / "run", start="resume")
    first.close()
    with pytest.raises(clsplat.errors.ClsplatError, match="is closed; create a new one"):
        first.step()
    second = clsplat.Trainer(tiny_scene, "smoke", set=few, out=tmp_path / "run", start="resume")
    assert second.run().step == 3
    assert second.checkpoint().exists()
    third = clsplat.Trainer(tiny_scene, "smoke", set=few, out=tmp_path / "run", start="resume")
    assert third.run() is None
    fourth = clsplat.Trainer(tiny_scene, "smoke", set={"optimize.steps": 4}, out=tmp_path / "run", start="resume")
    with pytest.raises(OutputError, match="is in use by this process"):
        clsplat.resume(tmp_path / "run")
    del fourth
    assert not (tmp_path / "run" / LOCK).exists()


def test_run_just_starting_in_the_default_folder_is_not_joined(tmp_path):
    assert find_free_folder(tmp_path / "splat", None, "new").out == tmp_path / "splat"
    (tmp_path / "splat").mkdir()
    with lock.lock_folder(tmp_path / "splat"):
        assert find_free_folder(tmp_path / "splat", None, "new").out == tmp_path / "splat-2"
    assert find_free_folder(tmp_path / "splat", None, "new").out == tmp_path / "splat"


def test_killed_start_does_not_change_the_default_folder(tmp_path):
    (tmp_path / "splat").mkdir()
    process = holder(tmp_path / "splat")
    assert find_free_folder(tmp_path / "splat", None, "new").out == tmp_path / "splat-2"
    process.kill()
    process.wait()
    assert (tmp_path / "splat" / LOCK).exists()
    assert find_free_folder(tmp_path / "splat", None, "new").out == tmp_path / "splat"


def test_folder_that_another_thread_is_locking_is_locked(tmp_path, monkeypatch):
    """Without locks, it would look like a leftover of an earlier process with the same ID."""
    locked, waiting, go_on = lock._acquire, threading.Event(), threading.Event()

    def slow(path, folder):
        if threading.current_thread() is thread:
            waiting.set()
            go_on.wait(20)
        return locked(path, folder)

    def hold():
        with lock.lock_folder(tmp_path):
            pass

    monkeypatch.setattr(lock, "_acquire", slow)
    thread = threading.Thread(target=hold)
    thread.start()
    try:
        assert waiting.wait(20)
        with pytest.raises(OutputError, match="is in use by this process"):
            hold()
    finally:
        go_on.set()
        thread.join()
    hold()


ELSEWHERE = {"process": 7, "host": "another", "boot": "of another", "time": 0.0, "command": "clsplat run"}
FRESH = {"state": "running", "time": 2.0}
known_boot = pytest.mark.skipif(Owner.current().boot is None, reason="the system does not say which start this is")


@pytest.mark.parametrize(
    ("name", "status"),
    [
        ("another", {"state": "starting", "time": -30.0}),
        ("another", {"state": "running", "time": -3600.0}),
        pytest.param(platform.node(), FRESH, marks=known_boot),
    ],
)
def test_remote_run_is_not_joined_where_locks_are_local(name, status, tmp_path, monkeypatch):
    """As with NFS and `local_lock`, where the lock is free locally.  A negative age means a fast clock."""
    (tmp_path / LOCK).write_text(json.dumps({**ELSEWHERE, "host": name}))
    before = (tmp_path / LOCK).read_text()
    (tmp_path / "status.json").write_text(json.dumps({**status, "time": time.time() - status["time"]}))
    beats = []

    def beat(seconds):  # of the other machine
        beats.append(seconds)
        (tmp_path / "status.json").write_text(json.dumps({**status, "time": time.time() - status["time"] + 1}))

    monkeypatch.setattr(holder_file.time, "sleep", beat)
    assert not lock.check_free(tmp_path)
    with (
        pytest.raises(
            OutputError, match=rf"by process 7 on {name} .*heartbeat of that process was \d+ s ago.*remove .*lock"
        ),
        lock.lock_folder(tmp_path),
    ):
        pass
    assert (tmp_path / LOCK).read_text() == before
    assert len(beats) == 1


@pytest.mark.parametrize("ahead", [-2, 86400])
def test_run_silent_for_a_minute_is_taken_over_despite_clocks(ahead, tmp_path, monkeypatch, caplog):
    """As for a job restarted on another machine right after a kill."""
    caplog.set_level("INFO", "clsplat")
    start = time.time()
    (tmp_path / LOCK).write_text(json.dumps(ELSEWHERE))
    (tmp_path / "status.json").write_text(json.dumps({"state": "running", "time": start + ahead}))
    now = [0.0]
    monkeypatch.setattr(holder_file.time, "sleep", lambda seconds: now.append(now[-1] + seconds))
    monkeypatch.setattr(holder_file.time, "monotonic", lambda: now[-1])
    monkeypatch.setattr(holder_file.time, "time", lambda: start + now[-1])
    with lock.lock_folder(tmp_path):
        pass
    assert now[-1] == (58 if ahead < 0 else 60)
    assert "waiting up to a minute for a heartbeat from there" in caplog.text


@pytest.mark.parametrize(
    ("owner", "status"),
    [
        ({}, {"state": "done", "time": 1.0}),
        ({}, {"state": "running", "time": 61.0}),
        ({}, {"state": "running"}),
        ({}, ["running"]),
        ({}, None),
        pytest.param({"boot": Owner.current().boot}, FRESH, marks=known_boot),
    ],
    ids=["ended", "silent", "without a time", "damaged", "no status", "in a container here"],
)
def test_lock_of_a_run_that_ended_elsewhere_is_taken_over(owner, status, tmp_path, caplog):
    caplog.set_level("INFO", "clsplat")
    (tmp_path / LOCK).write_text(json.dumps({**ELSEWHERE, **owner}))
    if isinstance(status, dict) and "time" in status:
        status = {**status, "time": time.time() - status["time"]}
    if status is not None:
        (tmp_path / "status.json").write_text(json.dumps(status))
    assert lock.check_free(tmp_path)
    with lock.lock_folder(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
    lines = [f"{tmp_path}: taken over from process 7 on another"] * (not owner)
    assert [line for line in caplog.messages if "taken over" in line] == lines


def test_run_that_wakes_up_notices_the_takeover(tmp_path, monkeypatch):
    """As after a suspension of a minute, with machine-local locks."""
    monkeypatch.setattr(lock, "_system_lock", lambda file: True)
    own = lock.owner_record
    with monkeypatch.context() as patch:
        patch.setattr(
            lock, "owner_record", lambda: json.dumps({**json.loads(own()), "host": "another", "boot": "another"})
        )
        first = lock.lock_folder(tmp_path)
        require_lock = first.__enter__()
    (tmp_path / "status.json").write_text(json.dumps({"state": "running", "time": time.time() - 61}))
    lock._locked_files.clear()
    with lock.lock_folder(tmp_path) as second:
        with pytest.raises(OutputError, match=f"replaced while .* process {os.getpid()} on .* holds it now"):
            require_lock()
        first.__exit__(None, None, None)
        second()
    assert not (tmp_path / LOCK).exists()


def test_heartbeat_stops_when_the_run_folder_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 0.002)
    with run_folder.open_run_folder(RunState.read(tmp_path / "run"), "new") as status:
        pass
    (tmp_path / "run" / "status.json").write_text("of the next")
    status._thread.join(5)
    assert not status._thread.is_alive()
    assert (tmp_path / "run" / "status.json").read_text() == "of the next"


def test_windows_locks_one_byte_after_the_text(tmp_path, monkeypatch):
    """With a stand-in for its module: who locks a byte twice is refused, and nothing is truncated or written there."""
    locked: set[tuple[int, int]] = set()
    fake = ModuleType("msvcrt")
    fake.LK_NBLCK = 2

    def locking(number: int, kind: int, size: int) -> None:
        assert (kind, size) == (fake.LK_NBLCK, 1)
        place = os.fstat(number).st_ino, os.lseek(number, 0, os.SEEK_CUR)
        if place in locked:
            raise OSError(errno.EACCES, "Permission denied")
        locked.add(place)

    fake.locking = locking
    monkeypatch.setitem(sys.modules, "msvcrt", fake)
    monkeypatch.setattr(lock, "os", SimpleNamespace(**{**vars(os), "name": "nt"}))
    path = tmp_path / LOCK
    with path.open("w+b", buffering=0) as file, path.open("r+b", buffering=0) as other:
        file.write(b'{"process": 7}')
        assert lock._system_lock(file)
        assert not lock._system_lock(other)
        assert {place for _, place in locked} == {holder_file.LOCK_OFFSET}
        assert holder_file.read_owner(other) == {"process": 7}, "readers need no lock"
    path.unlink()
    locked.clear()
    with lock.lock_folder(tmp_path):
        assert json.loads(path.read_text())["process"] == os.getpid()
    assert not path.exists()
