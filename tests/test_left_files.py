"""What killed processes leave: temporary files are swept, and those in use are not."""

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from clsplat import files
from clsplat.files import atomic
from clsplat.runs import folders
from tests.test_cli import clsplat as command

pytestmark = pytest.mark.slow
NONE = 99999999  # no process has this number


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
