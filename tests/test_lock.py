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

import pytest

import clsplat
from clsplat import files
from clsplat.errors import ConfigError, OutputError
from clsplat.files import atomic
from clsplat.names import LOCK
from clsplat.runs import experiment, folders, lock
from clsplat.training import status as writing
from tests.test_cli import clsplat as command

pytestmark = pytest.mark.slow
NONE = 99999999  # no process has this number


def holder(folder: Path) -> subprocess.Popen:
    """A process that holds a folder until it is killed."""
    code = (
        "import sys, time; from pathlib import Path; from clsplat.runs import lock\n"
        "with lock.held(Path(sys.argv[1])): print('held', flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def test_another_process_is_refused_and_told_who_holds_the_folder(tmp_path):
    process = holder(tmp_path)
    try:
        with pytest.raises(OutputError, match="is in use by process") as refused, lock.held(tmp_path):
            pass
        assert f"process {process.pid} on " in str(refused.value)
        assert "since 2" in str(refused.value)
        assert refused.value.exit_code == 7
    finally:
        process.kill()
        process.wait()


def test_a_lock_ends_with_its_process_however_it_ends(tmp_path):
    for number in (signal.SIGKILL, signal.SIGTERM):
        process = holder(tmp_path)
        process.send_signal(number)
        process.wait()
        assert (tmp_path / LOCK).exists()
        with lock.held(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
        assert not (tmp_path / LOCK).exists()


def test_children_do_not_hold_the_lock_of_a_killed_parent(tmp_path):
    code = (
        "import subprocess, sys, time; from pathlib import Path; from clsplat.runs import lock\n"
        "with lock.held(Path(sys.argv[1])):\n"
        "    child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "    print(child.pid, flush=True); time.sleep(600)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    child = int(process.stdout.readline())
    try:
        process.kill()
        process.wait()
        with lock.held(tmp_path):
            pass
    finally:
        os.kill(child, signal.SIGKILL)


def test_one_process_holds_a_folder_once_by_whatever_name(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").symlink_to("a")
    with lock.held(tmp_path / "a"):
        for folder in (tmp_path / "a", tmp_path / "b", tmp_path / "a" / ".." / "a"):
            with pytest.raises(OutputError, match="is in use by this process"), lock.held(folder):
                pass
    with lock.held(tmp_path / "b"):
        pass


NO_LOCKS = """
import errno, fcntl, logging
def no_locks(*arguments):
    raise OSError(errno.ENOLCK, "no locks")
fcntl.flock = no_locks
logging.disable()
"""


@pytest.mark.parametrize("before", ["", NO_LOCKS], ids=["with locks", "without"])
def test_of_many_that_want_a_folder_at_once_one_has_it(before, tmp_path):
    code = before + (
        "import sys, time; from pathlib import Path; from clsplat.runs import lock\n"
        "from clsplat.errors import OutputError\n"
        "folder, n = Path(sys.argv[1]), 0\n"
        "for _ in range(60):\n"
        "    try:\n"
        "        with lock.held(folder):\n"
        "            (folder / 'inside').mkdir(); time.sleep(0.001); (folder / 'inside').rmdir(); n += 1\n"
        "    except OutputError: time.sleep(0.001)\n"
        "print(n)"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    ends = [process.communicate(timeout=120) for process in processes]
    assert [errors for _, errors in ends] == [""] * 4, "never two inside at once"
    assert sum(int(out) for out, _ in ends) > 0


def test_a_file_that_its_holder_has_just_removed_is_not_the_lock(tmp_path, monkeypatch):
    system_lock, calls = lock._system_lock, []

    def late(file):
        calls.append(file)
        if len(calls) == 1:
            (tmp_path / LOCK).unlink()
        return system_lock(file)

    monkeypatch.setattr(lock, "_system_lock", late)
    with lock.held(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()


@pytest.fixture(params=[errno.ENOLCK, errno.ENOTSUP], ids=errno.errorcode.get)
def without_locks(request, monkeypatch):
    def no_locks(file, kind):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr("fcntl.flock", no_locks)


def owned_by(folder: Path, **values) -> None:
    owner = {"process": os.getpid(), "host": platform.node(), "time": time.time(), "command": "clsplat run"}
    (folder / LOCK).write_text(json.dumps({**owner, **values}))


def test_a_file_system_without_locks_is_warned_of_and_a_dead_owner_replaced(tmp_path, without_locks, caplog):
    caplog.set_level("INFO", "clsplat")
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for values in ({"process": ended.pid}, {}):  # {}: an earlier process with the number of this one
        owned_by(tmp_path, **values)
        with lock.held(tmp_path):
            assert f"taken over from process {values.get('process', os.getpid())}, which has ended" in caplog.text
            with pytest.raises(OutputError, match="is in use by this process"), lock.held(tmp_path):
                pass
        assert not (tmp_path / LOCK).exists()
    assert "its file system knows no locks" in caplog.text


def test_a_lock_that_is_just_being_made_is_somebodys(tmp_path, without_locks):
    """Between making the file and writing into it; or a process was killed there."""
    (tmp_path / LOCK).touch()
    with pytest.raises(OutputError, match=r"another process; .* has ended, remove .*run.lock"), lock.held(tmp_path):
        pass
    assert (tmp_path / LOCK).exists()


def test_a_lock_that_was_made_since_is_not_removed_with_a_dead_one(tmp_path, without_locks, monkeypatch):
    """Two processes find the same dead owner; the slower one finds the file of the other in its place."""
    owned_by(tmp_path, process=NONE)
    has_ended = lock._has_ended

    def slow(owner):
        ended = has_ended(owner)
        if ended:
            (tmp_path / LOCK).unlink()
            owned_by(tmp_path, process=os.getppid())
        return ended

    monkeypatch.setattr(lock, "_has_ended", slow)
    with pytest.raises(OutputError, match=f"in use by process {os.getppid()} on"), lock.held(tmp_path):
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
    ],
)
def test_a_file_system_without_locks_keeps_the_owner_that_may_live(values, tmp_path, without_locks):
    owned_by(tmp_path, **values)
    with pytest.raises(OutputError, match=r"if that process has ended, remove .*run.lock"), lock.held(tmp_path):
        pass
    assert (tmp_path / LOCK).exists()


def test_two_runs_in_one_folder(tiny_scene, tmp_path):
    """The second is refused while the first goes on, with and without --resume; the first ends undisturbed."""
    out = tmp_path / "run"
    arguments = ["run", "smoke", "--scene", str(tiny_scene), "--out", str(out), "--set", "optimize.steps=1000000"]
    process = subprocess.Popen([sys.executable, "-m", "clsplat", *arguments], stdout=subprocess.DEVNULL)
    try:
        while not (out / "metrics.jsonl").exists() or not (out / "metrics.jsonl").read_text():
            assert process.poll() is None
            time.sleep(0.05)
        status = json.loads((out / "status.json").read_text())
        assert f"{out}: already holds a run; " in command(*arguments, expect=2).stderr
        for more in ("--resume", "--restart"):
            refused = command(*arguments, more, expect=7)
            assert f"{out}: is in use by process {process.pid} on " in refused.stderr
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
    with pytest.raises(OutputError, match="is in use by this process; end that run or trainer first"):
        clsplat.Trainer(tiny_scene, "smoke", set=few, out=tmp_path / "run", start="resume")
    first.close()
    with pytest.raises(clsplat.errors.ClsplatError, match="is closed; make another"):
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


def test_a_run_that_is_just_starting_in_the_default_folder_is_not_joined(tmp_path):
    assert folders.free_folder(tmp_path / "splat", None, "new") == tmp_path / "splat"
    (tmp_path / "splat").mkdir()
    with lock.held(tmp_path / "splat"):
        assert folders.free_folder(tmp_path / "splat", None, "new") == tmp_path / "splat-2"
    assert folders.free_folder(tmp_path / "splat", None, "new") == tmp_path / "splat"


def test_a_folder_that_was_left_is_written_to_no_more(tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "BEAT", 0.002)
    with folders.opened(tmp_path / "run", "new") as status:
        pass
    (tmp_path / "run" / "status.json").write_text("of the next")
    status._thread.join(5)
    assert not status._thread.is_alive()
    assert (tmp_path / "run" / "status.json").read_text() == "of the next"


# What killed processes leave


def test_temporary_files_of_killed_runs_are_swept_and_nothing_else(tiny_scene, tmp_path):
    out = tmp_path / "run"
    left = [
        f".status.json.{NONE}-3.partial",
        f"checkpoints/.step_000010.npz.{NONE}-0.partial",
        f"renders/test/.r_1.png.{NONE}-12.partial",
    ]
    mine = [".status.json.77", ".partial", f"x.{NONE}-2.partial", "own/.x.partial"]
    mine.append(f"cell/.status.json.{NONE}-3.partial")
    for name in (*left, *mine, "cell/pipeline.yaml", "pipeline.yaml"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("x")
    done = command(
        "run", "smoke", "--scene", tiny_scene, "--out", out, "--resume", "--set", "optimize.steps=2", "--debug"
    )
    assert done.stdout.count("which a killed run has left") == len(left)
    assert [name for name in left if (out / name).exists()] == []
    assert [name for name in mine if not (out / name).exists()] == []


def test_what_a_process_still_writes_is_not_swept(tmp_path):
    other, old = tmp_path / f".a.{os.getppid()}-0.partial", tmp_path / f".b.{os.getpid()}-99999999.partial"
    for path in (other, old):
        path.write_text("x")
    with atomic(tmp_path / "c") as file:
        file.write(b"x")
        with folders.opened(tmp_path, "new", step=0):
            pass
    assert (tmp_path / "c").read_bytes() == b"x"
    assert other.exists()
    assert not old.exists(), "left by an earlier process of this number, as in a container"


def test_a_process_killed_at_any_write_leaves_what_the_next_one_sweeps(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from clsplat.files import atomic\n"
        "with atomic(Path(sys.argv[1]) / 'a.txt') as file:\n"
        "    file.write(b'x'); file.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    (name,) = [path.name for path in tmp_path.iterdir()]
    assert files.PARTIAL.fullmatch(name)
    files.sweep(tmp_path, border="pipeline.yaml")
    assert list(tmp_path.iterdir()) == []


def test_the_folder_is_synced_after_the_rename_and_before_an_older_checkpoint_goes(tmp_path, monkeypatch):
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, real=real, name=name: (calls.append((name, *a)), real(*a)))
    with atomic(tmp_path / "a") as file:
        file.write(b"x")
        number = file.fileno()
    assert [call[0] for call in calls] == ["fsync", "replace", "fsync"]
    assert calls[0][1] == number


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EACCES])
def test_a_folder_that_cannot_be_synced_is_no_failure(number, tmp_path, monkeypatch):
    real = os.open
    monkeypatch.setattr(
        os, "open", lambda path, *a, **k: real(path, *a, **k) if Path(path).is_file() else _raise(number)
    )
    with atomic(tmp_path / "a") as file:
        file.write(b"x")
    assert (tmp_path / "a").read_bytes() == b"x"
    monkeypatch.delattr(os, "O_DIRECTORY")
    with atomic(tmp_path / "a") as file:
        file.write(b"y")
    assert (tmp_path / "a").read_bytes() == b"y"


def _raise(number: int) -> None:
    raise OSError(number, os.strerror(number))


def test_threads_that_write_one_file_do_not_disturb_each_other(tmp_path):
    faults = []

    def write(letter: bytes) -> None:
        try:
            for _ in range(50):
                with atomic(tmp_path / "a") as file:
                    file.write(letter * 1000)
                assert len(set((tmp_path / "a").read_bytes())) == 1
        except Exception as error:
            faults.append(error)

    threads = [threading.Thread(target=write, args=(bytes([65 + i]),)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert faults == []


# Runs that are refused


def test_a_refused_run_leaves_no_folder(tiny_scene, tmp_path):
    for name, arguments in {
        "a/b": ["smoke", "--scene", tmp_path / "nowhere"],
        "c": ["smoke", "--scene", tiny_scene, "--device", "no such device"],
        "d": ["smoke", "--scene", tiny_scene, "--set", "evaluate.lpips=nowhere.onnx"],
    }.items():
        out = tmp_path / name
        done = subprocess.run(
            [sys.executable, "-m", "clsplat", "run", *map(str, arguments), "--out", str(out)],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode in (2, 3, 4), done.stderr
        assert not (tmp_path / name.split("/")[0]).exists(), name
        out.mkdir(parents=True)
        again = subprocess.run(done.args, capture_output=True, text=True, check=False)
        assert again.returncode == done.returncode
        status = json.loads((out / "status.json").read_text())
        assert (status["state"], status["exit_code"]) == ("failed", done.returncode)
        assert f"error: {status['message']}" in again.stderr
        assert not (out / LOCK).exists()


def test_a_folder_with_files_of_others_stays(tiny_scene, tmp_path, monkeypatch):
    def open_run(pipeline, out, *others):
        (out / "notes.txt").write_text("mine")
        raise ConfigError("refused")

    monkeypatch.setattr(experiment.opening, "open_run", open_run)
    with pytest.raises(ConfigError, match="refused"):
        clsplat.run("smoke", tiny_scene, tmp_path / "run")
    assert (tmp_path / "run" / "notes.txt").read_text() == "mine"
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "failed"


# --restart


def test_restart_begins_again_and_leaves_the_files_of_others(tiny_scene, tmp_path):
    out = tmp_path / "run"
    arguments = ["run", "smoke", "--scene", tiny_scene, "--out", out, "--set", "optimize.steps=20", "init.count=100"]
    command(*arguments)
    (out / "notes.txt").write_text("mine")
    (out / "checkpoints" / "failed_000003.npz").write_text("x")
    assert "already holds a run; give another folder, --resume or --restart" in command(*arguments, expect=2).stderr
    assert "give one of them" in command(*arguments, "--resume", "--restart", expect=2).stderr
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
    broken = command("resume", out, expect=7)
    assert "no checkpoint is whole" in broken.stderr
    advice = broken.stderr.split("`")[1].split()
    assert advice[0] == "clsplat"
    command(*advice[1:])
    assert clsplat.status(out)["state"] == "done"
