"""A run with a live page, and a background thread."""

import threading
from contextlib import contextmanager
from pathlib import Path

from clsplat.pipeline.loading import load
from clsplat.runs import opening, run_folder, runner
from clsplat.runs.failures import recording_failures
from clsplat.runs.live.live import Live
from clsplat.runs.state import RunState
from clsplat.training.run import Run
from tests.support.runs import FEW


def trained(live: Live, scene: Path, out: Path, *overrides: str) -> Run:
    checked = load("smoke", [f"scene.path='{scene}'", *FEW, *overrides])
    with run_folder.open_run_folder(RunState.read(out), "new", step=0) as status, recording_failures(status):
        live.follow(status)
        run = opening.open_run(checked, out, None, "new", status)
        with live.showing(run):
            runner.execute(checked, run, "new", live.reporting(lambda progress: None))
    return run


@contextmanager
def in_background(act):
    """Run a function in a thread; fail if it fails."""
    faults = []

    def guarded():
        try:
            act()
        except BaseException as error:
            faults.append(error)

    thread = threading.Thread(target=guarded)
    thread.start()
    yield
    thread.join(60)
    assert not thread.is_alive()
    assert not faults, faults
