"""A signal in the first second ends the command with its message and exit code."""

import contextlib
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from clsplat.core.errors import Interrupted
from clsplat.core.signals import stop_at_once, stopping_on_signals
from clsplat.runs import opening
from clsplat.sweeps.experiment import Job

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="SIGTERM ends a process at once there")

START = """
import signal, sys
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup it is ignored
sys.argv = ["clsplat", "run", "smoke", "--scene", "nowhere"]
"""
END = "\nimport runpy\nrunpy.run_module('clsplat', run_name='__main__', alter_sys=False)\n"
IN_TYPER = """
import typer.core
make = typer.core.TyperGroup.make_context
def signalled(*arguments, **named):
    signal.raise_signal(signal.SIGTERM)
    return make(*arguments, **named)
typer.core.TyperGroup.make_context = signalled
"""
IN_IMPORT = """
class Finder:
    def find_spec(name, path, target=None):
        if name == {name!r}:
            {catching}signal.raise_signal(signal.{signal})
sys.meta_path.insert(0, Finder)
"""
SWALLOWED = "import contextlib\n            with contextlib.suppress(BaseException): "
PLACES = {
    "before the command": IN_TYPER,
    "the import of the command line": IN_IMPORT.format(name="typer", catching="", signal="SIGINT"),
    "the import of an extension": IN_IMPORT.format(name="pyopencl", catching="", signal="SIGINT"),
    "an import that catches all": IN_IMPORT.format(name="pyopencl", catching=SWALLOWED, signal="SIGHUP"),
    "caught while the command line is imported": IN_IMPORT.format(name="typer", catching=SWALLOWED, signal="SIGTERM"),
}


@pytest.mark.parametrize("place", PLACES)
def test_signal_at_the_start_exits_with_130_and_a_message(place, tmp_path):
    script = START + PLACES[place] + END
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=60, check=False)
    assert done.returncode == 130, done.stderr
    assert done.stderr.startswith("stopped")  # at once, where the run has been opened by then
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_signal_during_an_import_waits_for_the_import(tmp_path, monkeypatch):
    (tmp_path / "slow_module.py").write_text("import signal\nsignal.raise_signal(signal.SIGTERM)\nDONE = True\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), stopping_on_signals(stop_at_once):  # noqa: PT012
        import slow_module

        assert slow_module.DONE
        time.sleep(5)


def test_hanging_import_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.core.signals.IMPORT_SECONDS", 0.2)
    loop = f"while time.monotonic() < {time.monotonic() + 30}:\n    time.sleep(0.01)\n"
    endless = "import signal, time\nsignal.raise_signal(signal.SIGTERM)\n" + loop
    (tmp_path / "endless_module.py").write_text(endless)
    monkeypatch.syspath_prepend(tmp_path)
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt), stopping_on_signals(stop_at_once):
        import endless_module  # noqa: F401
    assert time.monotonic() - begun < 10


def test_signal_that_a_library_catches_stops_the_run(tiny_scene: Path, tmp_path: Path, monkeypatch):
    check = opening.check_start

    def catching(*arguments):
        with contextlib.suppress(BaseException):  # as a callback of an extension
            signal.raise_signal(signal.SIGTERM)
        return check(*arguments)

    monkeypatch.setattr(opening, "check_start", catching)
    for _ in range(2):
        with pytest.raises(Interrupted, match="stopped at once; run the same command again to continue"):
            Job.open("smoke", tiny_scene, tmp_path / "run").run()
        assert not (tmp_path / "run").exists()
    monkeypatch.setattr(opening, "check_start", check)
    Job.open("smoke", tiny_scene, tmp_path / "run", ["optimize.steps=1", "optimize.during=[]"]).run()
