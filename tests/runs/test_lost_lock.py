"""A process whose run.lock was removed or replaced ends with one sentence and writes nothing more."""

import json
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from clsplat.core import lock
from clsplat.core.errors import OutputError
from clsplat.core.files import LOCK
from clsplat.runs import run_folder
from clsplat.runs.state import RunState
from clsplat.stages.densify import Densify
from clsplat.sweeps.experiment import Job
from clsplat.training import checkpoint
from clsplat.training import status as writing
from tests.support.runs import FEW

GONE = "run.lock was removed or replaced while this process held it"
OTHER = json.dumps({"process": 4321, "host": "there", "time": 0, "command": "clsplat resume"})


def take_folder(out: Path) -> dict[str, bytes]:
    """Let another process take the folder and write into it; return its files."""
    (out / LOCK).unlink()
    (out / LOCK).write_text(OTHER)
    (out / "status.json").write_text(OTHER)
    return files(out)


def files(out: Path) -> dict[str, bytes]:
    """What lies in a run folder, but for the log, to which lines are added."""
    actual = (path for path in out.rglob("*") if path.is_file() and path.name != "log.txt")
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in actual}


def removed(out: Path) -> dict[str, bytes]:
    """Remove the lock; return the files that are left."""
    (out / LOCK).unlink()
    return files(out)


def test_holder_can_check_its_lock(tmp_path):
    with lock.lock_folder(tmp_path) as require_lock:
        require_lock()
        (tmp_path / LOCK).unlink()
        with pytest.raises(OutputError, match=f"{GONE}; nothing more was written") as gone:
            require_lock()
        assert gone.value.exit_code == 7
        (tmp_path / LOCK).write_text(OTHER)
        with pytest.raises(OutputError, match=f"{GONE}, and process 4321 on there holds it now; "):
            require_lock()
    assert (tmp_path / LOCK).read_text() == OTHER, "the other's is left alone"
    require_lock()  # after the block it is nobody's matter


def run(scene: Path, out: Path) -> None:
    Job.open("smoke", scene, out, FEW).run()


@pytest.mark.parametrize(
    ("take", "failure"),
    [(take_folder, None), (take_folder, KeyboardInterrupt()), (removed, None), (removed, RuntimeError("a defect"))],
)
def test_run_that_lost_its_folder_writes_nothing_more(take, failure, tiny_scene, tmp_path, monkeypatch):
    """It loses the folder at step 8, in an edit before the second checkpoint; with a failure, that ends it, too."""
    before: dict[str, bytes] = {}
    edit: Callable[..., None] = Densify.run

    def losing(stage: Densify, state) -> None:
        edit(stage, state)
        if state.step == 8:
            before.update(take(state.out))
            if failure is not None:
                raise failure

    monkeypatch.setattr(Densify, "run", losing)
    with pytest.raises(Exception, match=GONE if failure is None else None) as ended:
        run(tiny_scene, tmp_path)
    if failure is None:
        assert ended.value.exit_code == 7
    assert "checkpoints/step_000004.npz" in before
    assert files(tmp_path) == before


def test_emergency_save_skips_a_lost_folder(tiny_scene, tmp_path, monkeypatch):
    """The stage that saves fails the first time: the state is whole, and would be rescued."""
    before: dict[str, bytes] = {}
    save = checkpoint.save

    def failing(state, keep=None) -> None:
        if state.step == 8 and not before:
            before.update(take_folder(state.out))
            raise RuntimeError("a defect")
        save(state, keep)

    monkeypatch.setattr(checkpoint, "save", failing)
    with pytest.raises(Exception, match="a defect"):
        run(tiny_scene, tmp_path)
    assert files(tmp_path) == before


def test_heartbeat_stops_and_reports_a_lost_folder(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(writing, "HEARTBEAT_INTERVAL_S", 0.002)
    with run_folder.open_run_folder(RunState.read(tmp_path / "run"), "new") as status:
        before = take_folder(tmp_path / "run")
        while status.lock_error is None:
            time.sleep(0.001)
        with pytest.raises(OutputError, match=GONE):
            status.note(step=1)  # as a training does at each step
    assert files(tmp_path / "run") == before
    assert "the run continues" not in caplog.text


def test_run_ending_before_its_first_step_keeps_the_new_status(tmp_path):
    before: dict[str, bytes] = {}

    def ends() -> None:
        with run_folder.open_run_folder(RunState.read(tmp_path / "run"), "new"):
            before.update(take_folder(tmp_path / "run"))
            raise ValueError("ends")

    with pytest.raises(ValueError, match="ends"):
        ends()
    assert files(tmp_path / "run") == before
