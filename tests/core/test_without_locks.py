"""A file system without locks: creating run.lock reserves the folder, and a dead owner is replaced."""

import errno
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clsplat.core import lock, machine
from clsplat.core.errors import OutputError
from clsplat.core.files import LOCK

pytest.importorskip("fcntl", reason="what they change is of POSIX")
pytestmark = pytest.mark.slow
NONE = 99999999  # no process has this number


@pytest.fixture(params=[errno.ENOLCK, errno.ENOTSUP], ids=errno.errorcode.get)
def without_locks(request, monkeypatch):
    def no_locks(file, kind):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr("fcntl.flock", no_locks)


def owned_by(folder: Path, **values) -> None:
    owner = {"process": os.getpid(), "host": platform.node(), "time": time.time(), "command": "clsplat run"}
    (folder / LOCK).write_text(json.dumps({**owner, **values}))


def test_missing_locks_warn_and_a_dead_owner_is_replaced(tmp_path, without_locks, caplog):
    caplog.set_level("INFO", "clsplat")
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for values in ({"process": ended.pid}, {}):  # {}: an earlier process with the number of this one
        owned_by(tmp_path, **values)
        with lock.lock_folder(tmp_path):
            assert f"taken over from process {values.get('process', os.getpid())}, which has exited" in caplog.text
            with pytest.raises(OutputError, match="is in use by this process"), lock.lock_folder(tmp_path):
                pass
        assert not (tmp_path / LOCK).exists()
    assert "the file system does not support locks" in caplog.text


def test_owner_from_before_a_reboot_has_ended(tmp_path, without_locks, monkeypatch):
    """Its number is that of a living process by now."""
    monkeypatch.setattr(machine, "_pid_namespace", lambda: machine.FIRST_PID_NAMESPACE)
    monkeypatch.setattr(machine, "_boot_id", lambda: "now")
    owned_by(tmp_path, process=os.getppid(), boot="before")
    with lock.lock_folder(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["boot"] == "now"


def test_incomplete_lock_counts_as_held(tmp_path, without_locks):
    """Between making the file and writing into it; or a process was killed there."""
    (tmp_path / LOCK).touch()
    with (
        pytest.raises(OutputError, match=r"another process; .* has exited, remove .*run.lock"),
        lock.lock_folder(tmp_path),
    ):
        pass
    assert (tmp_path / LOCK).exists()


def test_newer_lock_is_not_removed_with_a_dead_one(tmp_path, without_locks, monkeypatch):
    """Two processes find the same dead owner; the slower one finds the file of the other in its place."""
    owned_by(tmp_path, process=NONE)
    has_ended = lock._has_exited

    def slow(owner):
        ended = has_ended(owner)
        if ended:
            (tmp_path / LOCK).unlink()
            owned_by(tmp_path, process=os.getppid())
        return ended

    monkeypatch.setattr(lock, "_has_exited", slow)
    with pytest.raises(OutputError, match=f"in use by process {os.getppid()} on"), lock.lock_folder(tmp_path):
        pass
    assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getppid()
    assert [path.name for path in tmp_path.iterdir()] == [LOCK]


@pytest.mark.parametrize(
    "values",
    [
        pytest.param({"process": 1}, id="alive"),
        pytest.param({"host": "another"}, id="on another host"),
        pytest.param({"host": "another", "time": "x"}, id="since when is not known"),
        pytest.param({"process": NONE, "pid_namespace": "pid:[1]"}, id="in a container"),
        pytest.param({"process": NONE, "host": "another", "boot": "before"}, id="on another host, since its start"),
    ],
)
def test_possibly_live_owner_keeps_the_folder(values, tmp_path, without_locks):
    owned_by(tmp_path, **values)
    with pytest.raises(OutputError, match=r"if that process has exited, remove .*run.lock"), lock.lock_folder(tmp_path):
        pass
    with pytest.raises(OutputError, match=r"if that process has exited, remove .*run.lock"):
        lock.check_free(tmp_path)
    owned_by(tmp_path, process=NONE)
    assert lock.check_free(tmp_path)
    assert (tmp_path / LOCK).exists()
