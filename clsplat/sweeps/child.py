"""The process that runs one attempt: it ends when its supervisor does."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from clsplat.core import machine
from clsplat.core.files import raising_output_error
from clsplat.core.machine import Cores
from clsplat.pipeline import plugins
from clsplat.sweeps.store import ERRORS, PIPELINE_FILE, CellAttempt

# Ctrl-C in the terminal is for the supervisor, which passes it on
APART: dict[str, Any] = (
    {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    if os.name == "nt"
    else {"start_new_session": True}
)
POLL = 0.25  # seconds between two looks at a process
PATIENCE = 90.0  # seconds for the last step and its checkpoint, before the process is killed
Command = Sequence[str]  # words; these stand for what is known where it runs
PYTHON, FILE, OUT = "{python}", "{pipeline}", "{out}"


def run_command(device: str | None, plugins: Sequence[Path] = ()) -> Command:
    """Return the command of a run on a device, which ends when its standard input does.

    -P: nothing of the working folder is imported.
    """
    loaded = [word for path in plugins for word in ("--plugin", str(path))]
    chosen = ["--device", device] if device else []
    return [PYTHON, "-P", "-m", "clsplat", "--attended", *loaded, "run", FILE, "--out", OUT, "--resume", *chosen]


def filled(command: Command, pipeline: Path, out: Path) -> list[str]:
    """Return the words of a command for a pipeline file and a run folder."""
    values = {PYTHON: sys.executable, FILE: str(pipeline), OUT: str(out)}
    return [values.get(word, word) for word in command]


def supervise(attempt: CellAttempt, command: Command, is_stopped: Callable[[], bool], own: Cores = ()) -> int:
    """Run an attempt to its end; return its exit code, negative where a signal ended it.

    Where `is_stopped`, the run saves its state and ends.  own: the cores that it is kept to, none: those of this
    process.  Raises LeaseLost.
    """
    with raising_output_error(attempt.path), (attempt.path / ERRORS).open("wb") as errors:
        process = subprocess.Popen(
            filled(command, attempt.path / PIPELINE_FILE, attempt.path),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=machine.limited_environment(own) if own else None,
            **APART,
        )
        if own:
            machine.pin_to_cores(own, process.pid)  # before it has started a runtime
    try:
        code = _wait(process, attempt, is_stopped)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        if process.stdin:
            process.stdin.close()
    attempt.end(code)
    return code


def _wait(process: "subprocess.Popen[bytes]", attempt: CellAttempt, is_stopped: Callable[[], bool]) -> int:
    told: float | None = None
    while True:
        try:
            return process.wait(POLL)
        except subprocess.TimeoutExpired:
            pass
        attempt.beat()
        if told is None and is_stopped():
            told = time.monotonic()
            if process.stdin:
                process.stdin.close()  # the run finishes its step, saves and ends
        elif told is not None and time.monotonic() - told > PATIENCE:
            process.kill()


# Plug-ins that runs in other processes need too.


def plugin_files() -> list[Path]:
    """Return the files of the plug-ins that were loaded by path; those of packages are found again."""
    return [plugin.path for plugin in plugins.loaded() if not plugin.installed]
