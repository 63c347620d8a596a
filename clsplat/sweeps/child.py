"""Run an attempt in a child process that exits if its supervisor exits."""

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

# a separate process group: Ctrl-C in the terminal reaches only the supervisor, which passes it on
PROCESS_GROUP: dict[str, Any] = (
    {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    if os.name == "nt"
    else {"start_new_session": True}
)
POLL_INTERVAL_S = 0.25  # seconds between two checks of a process
STOP_TIMEOUT_S = 90.0  # for the last step and its checkpoint, before the process is killed
Command = Sequence[str]  # arguments; the machine that runs it replaces the placeholders
PYTHON, FILE, OUT = "{python}", "{pipeline}", "{out}"


def run_command(device: str | None, plugins: Sequence[Path] = ()) -> Command:
    """Return the command that executes a run on a device.  The run ends when its standard input is closed.

    The option -P removes the working folder from the import path.
    """
    plugin_options = [argument for path in plugins for argument in ("--plugin", str(path))]
    device_options = ["--device", device] if device else []
    return [
        PYTHON,
        "-P",
        "-m",
        "clsplat",
        "--attended",
        *plugin_options,
        "run",
        FILE,
        "--out",
        OUT,
        "--resume",
        *device_options,
    ]


def fill_command(command: Command, pipeline: Path, out: Path) -> list[str]:
    """Replace the placeholders of a command with the interpreter, a pipeline file, and a run folder."""
    values = {PYTHON: sys.executable, FILE: str(pipeline), OUT: str(out)}
    return [values.get(argument, argument) for argument in command]


def supervise(attempt: CellAttempt, command: Command, is_stopped: Callable[[], bool], cores: Cores = ()) -> int:
    """Wait until an attempt ends; return its exit code, or the negative number of the signal that ended it.

    is_stopped: returns whether the run has to save its state and end.  cores: the cores to which the run is pinned;
    empty: the cores of this process.  Raises LeaseLost.
    """
    with raising_output_error(attempt.path), (attempt.path / ERRORS).open("wb") as errors:
        process = subprocess.Popen(
            fill_command(command, attempt.path / PIPELINE_FILE, attempt.path),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env=machine.limited_environment(cores) if cores else None,
            **PROCESS_GROUP,
        )
        if cores:
            machine.pin_to_cores(cores, process.pid)  # before it starts a runtime
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
    stop_time: float | None = None  # time of the request to stop
    while True:
        try:
            return process.wait(POLL_INTERVAL_S)
        except subprocess.TimeoutExpired:
            pass
        attempt.beat()
        if stop_time is None and is_stopped():
            stop_time = time.monotonic()
            if process.stdin:
                process.stdin.close()  # the run finishes its step, saves its state, and ends
        elif stop_time is not None and time.monotonic() - stop_time > STOP_TIMEOUT_S:
            process.kill()


def plugin_files() -> list[Path]:
    """Return the plug-in files that child processes have to load; installed plug-ins are loaded automatically."""
    return [plugin.path for plugin in plugins.loaded_plugins() if not plugin.is_installed]
