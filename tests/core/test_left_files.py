"""Leftovers of killed processes: temporary files are removed unless they are in use."""

import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import clsplat
from clsplat.core import files
from clsplat.core.errors import OutputError
from clsplat.core.files import append, open_atomic, write_text
from clsplat.core.manifest import RECORD as RECORD_OF_A_TOOL
from clsplat.core.manifest import Manifest
from clsplat.core.settings import Settings
from clsplat.prepare.cache import RECORD, STEPS, PlannedStep, _publish, prepare
from clsplat.prepare.steps import Step
from clsplat.runs import run_folder
from clsplat.runs.state import RunState
from clsplat.training import checkpoint
from tests.support.commands import clsplat as command
from tests.support.runs import NO_PROCESS

pytestmark = pytest.mark.slow


def test_only_temporary_files_of_killed_runs_are_swept(tiny_scene, tmp_path):
    out = tmp_path / "run"
    left = [
        f".status.json.{NO_PROCESS}-3.partial",
        f"checkpoints/.step_000010.npz.{NO_PROCESS}-0.partial",
        f"renders/test/.r_1.png.{NO_PROCESS}-12.partial",
    ]
    mine = [".status.json.77", ".partial", f"x.{NO_PROCESS}-2.partial", "own/.x.partial"]
    mine.append(f"cell/.status.json.{NO_PROCESS}-3.partial")
    for name in (*left, *mine, "cell/pipeline.yaml", "pipeline.yaml"):
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_text("x")
    (out / "pipeline.yaml").write_text("# resolved from smoke.yaml\n")
    done = command(
        "run", "smoke", "--scene", tiny_scene, "--out", out, "--resume", "--set", "optimize.steps=2", "--debug"
    )
    assert done.stdout.count("left by a killed run") == len(left)
    assert [name for name in left if (out / name).exists()] == []
    assert [name for name in mine if not (out / name).exists()] == []


def test_temporary_files_of_killed_tools_are_removed(tmp_path):
    left = tmp_path / "images" / f".a.png.{NO_PROCESS}-3.partial"
    left.parent.mkdir()
    left.write_text("x")
    Manifest(tmp_path)
    assert not left.exists()


def test_files_of_a_live_process_are_not_swept(tmp_path):
    other, old = tmp_path / f".a.{os.getppid()}-0.partial", tmp_path / f".b.{os.getpid()}-99999999.partial"
    for path in (other, old):
        path.write_text("x")
    with open_atomic(tmp_path / "c") as file:
        file.write(b"x")
        with run_folder.open_run_folder(RunState.read(tmp_path), "new", step=0):
            pass
    assert (tmp_path / "c").read_bytes() == b"x"
    assert other.exists()
    assert not old.exists(), "left by an earlier process of this number, as in a container"


def test_temporary_files_of_a_killed_write_are_swept_next(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path; from clsplat.core.files import open_atomic\n"
        "with open_atomic(Path(sys.argv[1]) / 'a.txt') as file:\n"
        "    file.write(b'x'); file.flush(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    (name,) = [path.name for path in tmp_path.iterdir()]
    assert files.PARTIAL.fullmatch(name)
    files.remove_partial_files(tmp_path, marker="pipeline.yaml")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def calls(monkeypatch):
    """Calls to the disk, in order: sync, replace, or unlink, and the name of the file or folder."""
    results: list[tuple[str, str]] = []
    real = {name: getattr(os, name) for name in ("fsync", "replace", "rename", "unlink")}

    def fsync(number):
        results.append(("sync", Path(os.readlink(f"/proc/self/fd/{number}")).name))
        real["fsync"](number)

    def replace(old, new):
        results.append(("replace", Path(new).name))
        real["replace"](old, new)

    def rename(old, new):
        results.append(("rename", Path(new).name))
        real["rename"](old, new)

    def unlink(path, **more):
        if os.path.lexists(path):
            results.append(("unlink", Path(path).name))
        real["unlink"](path, **more)

    for function in (fsync, replace, rename, unlink):
        monkeypatch.setattr(os, function.__name__, function)
    return results


has_proc = pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="the names of open files are read from there")


@has_proc
def test_checkpoint_is_synced_before_old_ones_are_removed(tiny_scene, tmp_path, calls):
    few = {"optimize.steps": 4, "init.count": 20, "checkpoint.every": 100, "optimize.log_every": 100}
    trainer = clsplat.Trainer(tiny_scene, "smoke", set=few, out=tmp_path / "run")
    trainer.step()
    trainer.checkpoint()
    trainer.step()
    trainer._run.records.add(2, "note")
    calls.clear()
    checkpoint.save(trainer._run, keep=1)
    trainer.close()
    new, old = "step_000002.npz", "step_000001.npz"
    seen = [call for call in calls if "status.json" not in call[1]]
    assert seen[0] == ("sync", "metrics.jsonl")
    assert seen[1][0] == "sync"
    assert seen[1][1].startswith(f".{new}.")
    assert [call for call in seen[2:] if call[1] in (new, old, "checkpoints")] == [
        ("replace", new),
        ("sync", "checkpoints"),
        ("unlink", old),
    ]


@has_proc
def test_run_folder_is_synced_with_its_parents(tmp_path, calls):
    with run_folder.open_run_folder(RunState.read(tmp_path / "a" / "run"), "new"):
        synced = [name for kind, name in calls if kind == "sync"]
    assert {tmp_path.name, "a"} <= {*synced}


@has_proc
def test_new_folder_is_synced_with_its_file(tmp_path, calls):
    with open_atomic(tmp_path / "a" / "b" / "c.txt") as file:
        file.write(b"x")
    synced = [name for kind, name in calls if kind == "sync"]
    assert (synced[:2], synced[3:]) == (["a", tmp_path.name], ["b"])
    calls.clear()
    with open_atomic(tmp_path / "a" / "b" / "c.txt") as file:
        file.write(b"y")
    assert [name for kind, name in calls if kind == "sync"][1:] == ["b"], "the others are there since"


@has_proc
def test_preparation_result_is_synced_before_it_is_trusted(tmp_path, calls):
    class Write(Step):
        def make(self, source: Path, out: Path, without: Path) -> dict:
            (out / "deep").mkdir()
            (out / "deep" / "x.png").write_bytes(b"x")
            return {}

    Settings.subclasses.remove(Write)  # not a step in other tests
    root = tmp_path / "prepared"
    planned = [PlannedStep(Write(stage="write"), "", "", root / "write-1", "no result yet")]
    prepare(planned, tmp_path, root)
    order = [call for call in calls if ".lock" not in call[1]]
    places = [order.index(call) for call in (("sync", "x.png"), ("sync", "deep"), ("replace", RECORD))]
    assert places == sorted(places)
    assert order[places[-1] + 1 :] == [("sync", ".write-1"), ("replace", "write-1"), ("sync", "prepared")]


@has_proc
def test_photograph_model_is_synced_before_it_is_renamed(tmp_path, calls):
    result = tmp_path / "result"
    for name in ("sparse", "images"):
        (result / name).mkdir(parents=True)
    (result / "sparse" / "cameras.bin").write_bytes(b"x")
    (tmp_path / "out" / STEPS).mkdir(parents=True)
    _publish(result, tmp_path / "out")
    assert calls == [("sync", "cameras.bin"), ("sync", ".sparse"), ("rename", "sparse"), ("sync", "out")]


@has_proc
def test_manifest_line_is_synced_before_its_file_is_written(tmp_path, calls):
    assert Manifest(tmp_path / "frames").needs_writing(tmp_path / "frames" / "a.png", "x")
    assert calls == [("sync", tmp_path.name), ("sync", RECORD_OF_A_TOOL), ("sync", "frames")]
    calls.clear()
    assert Manifest(tmp_path / "frames").needs_writing(tmp_path / "frames" / "b.png", "x")
    assert calls == [("sync", RECORD_OF_A_TOOL)]


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.EACCES])
def test_unsyncable_folder_is_no_failure(number, tmp_path, monkeypatch):
    real = os.open
    monkeypatch.setattr(
        os, "open", lambda path, *a, **k: real(path, *a, **k) if Path(path).is_file() else _raise(number)
    )
    with open_atomic(tmp_path / "a") as file:
        file.write(b"x")
    assert (tmp_path / "a").read_bytes() == b"x"
    monkeypatch.delattr(os, "O_DIRECTORY")
    with open_atomic(tmp_path / "a") as file:
        file.write(b"y")
    assert (tmp_path / "a").read_bytes() == b"y"


def _raise(number: int) -> None:
    raise OSError(number, os.strerror(number))


@pytest.mark.parametrize("before", [None, b"", b"first"])
def test_failed_append_leaves_the_file_unchanged(before, tmp_path, monkeypatch):
    path = tmp_path / "a"
    if before is not None:
        path.write_bytes(before)
    monkeypatch.setattr(os, "fsync", lambda number: _raise(errno.ENOSPC))
    with pytest.raises(OutputError, match="No space left"):
        append(path, b"second")
    assert (path.read_bytes() if path.exists() else None) == before


def test_threads_can_write_the_same_file(tmp_path):
    faults = []

    def write(letter: bytes) -> None:
        try:
            for _ in range(50):
                with open_atomic(tmp_path / "a") as file:
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


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have names on POSIX systems")
def test_only_regular_files_are_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match=r"pipe: cannot be written \(not a regular file\)"):
        write_text(tmp_path / "pipe", "text")
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]
