"""Run a module in a child process, for third-party code that may crash or hang."""

import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class ChildResult:
    """The exit code and the output of a child process."""

    code: int | None  # exit code; None: stopped after the time limit
    output: str  # standard output, then standard error

    @property
    def crash(self) -> str | None:
        """A verb phrase that describes a crash or hang, such as "crashes with SIGSEGV"; None if the process exited."""
        if self.code is None:
            return "hangs"
        return None if self.code in range(256) else f"crashes with {signal_name(self.code)}"


def run_module(
    module: str, *arguments: str, seconds: float, stdin: bytes = b"", variables: Mapping[str, str] | None = None
) -> ChildResult:
    """Run a module with arguments, standard input, and additional environment variables, for at most `seconds`."""
    command = [sys.executable, "-P", "-m", module, *arguments]  # -P: import nothing from the working folder
    environment = {**os.environ, **(variables or {})}
    try:
        process = subprocess.run(command, input=stdin, capture_output=True, timeout=seconds, env=environment)
    except subprocess.TimeoutExpired as error:
        return ChildResult(None, _decode(error.stdout, error.stderr))
    return ChildResult(process.returncode, _decode(process.stdout, process.stderr))


def signal_name(code: int) -> str:
    """Return the name of the signal that ended a child process, from its negative exit code."""
    return {member.value: member.name for member in signal.Signals}.get(-code, f"signal {-code}")


def _decode(*streams: bytes | None) -> str:
    return "\n".join((stream or b"").decode("utf-8", "replace") for stream in streams)
