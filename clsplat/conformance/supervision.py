"""Run checks in child processes, and continue after a check that crashes or hangs."""

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from clsplat.conformance.check import Check, Deviation, Note
from clsplat.core.child import signal_name
from clsplat.core.errors import shorten
from clsplat.opencl.discovery import DeviceInfo
from clsplat.opencl.kernel_caches import empty_kernel_caches

WORKER = ("-P", "-m", "clsplat.conformance.worker")  # -P: import nothing from the working folder
TIMEOUT_S = 900  # longest time without output from a check; a kernel interpreter needs minutes
EXIT_TIMEOUT_S = 30  # between the end of the output and the exit, during which a core dump may be written


@dataclass
class CheckResult:
    """The deviations that a check found on a device, and the fault that ended it, if any."""

    name: str
    kernels: tuple[str, ...]
    seconds: float = 0.0
    deviations: list[Deviation] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    fault: str | None = None  # the reason why the check could not be completed
    log: str = ""  # log of a failed build
    out_of_memory: bool = False  # whether the fault is a lack of memory
    hangs: bool = False  # whether the fault is a timeout or unreadable output
    damaged_cache: bool = False  # whether the check failed, but passed with empty caches of built kernels

    @property
    def passes(self) -> bool:
        return self.fault is None and all(deviation.passes for deviation in self.deviations)

    @property
    def failures(self) -> list[str]:
        """A sentence for each failure."""
        faults = [f"{self.name}: {shorten(self.fault, 240)}"] if self.fault else []
        return faults + [deviation.text for deviation in self.deviations if not deviation.passes]


def run_checks(
    info: DeviceInfo, schedule: str, checks: Sequence[Check], seconds: float = TIMEOUT_S
) -> Iterator[CheckResult]:
    """Run checks on a device with a schedule, and yield each result when it is complete.

    A check without output for `seconds` is stopped.  A check that cannot be completed is repeated with empty caches of
    built kernels.  If that repetition also fails, later checks are not repeated.
    """
    remaining, retry = list(checks), True
    while remaining:
        finished_count = 0
        for result in _run_in_process(info, schedule, remaining, seconds):
            if retry and result.fault and not result.out_of_memory and not result.hangs:
                second_result = _run_with_empty_caches(info, schedule, remaining[finished_count], seconds)
                retry = second_result.fault is None
                result = second_result if retry else result
            finished_count += 1
            yield result
        remaining = remaining[finished_count:]


def _run_with_empty_caches(info: DeviceInfo, schedule: str, check: Check, seconds: float) -> CheckResult:
    with empty_kernel_caches() as variables:
        (result,) = _run_in_process(info, schedule, [check], seconds, variables)
    result.damaged_cache = result.fault is None
    return result


def _run_in_process(
    info: DeviceInfo, schedule: str, checks: Sequence[Check], seconds: float, variables: Mapping[str, str] | None = None
) -> Iterator[CheckResult]:
    """Yield the results of the checks, up to and including the first check that ends the process."""
    command = [sys.executable, *WORKER, *map(str, info.index), schedule]
    names = [check.name for check in checks]
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as errors:
        process = subprocess.Popen(
            [*command, *names],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            encoding="utf-8",
            env={**os.environ, **(variables or {})},
        )
        assert process.stdin is not None  # the worker exits when it is closed
        assert process.stdout is not None
        lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=_forward_lines, args=(process.stdout, lines), daemon=True).start()
        try:
            for check in checks:
                result = CheckResult(check.name, check.kernels)
                stop_reason = _read_result(result, lines, seconds)
                if stop_reason is not None:
                    result.fault = stop_reason or _exit_reason(process, errors)
                    result.hangs = bool(stop_reason)
                yield result
                if stop_reason is not None:
                    return
        finally:
            process.kill()
            process.wait()
            process.stdin.close()


def _read_result(result: CheckResult, lines: "queue.Queue[str | None]", seconds: float) -> str | None:
    """Read the output of one check.

    Return None if the check is complete, "" if the process has ended, and otherwise the reason to stop the process.
    """
    while True:
        try:
            text = lines.get(timeout=seconds)
        except queue.Empty:
            return f"gives no answer within {seconds} s"
        if text is None:
            return ""
        try:
            line: dict[str, Any] = json.loads(text)
        except ValueError:
            return f"prints a line that is not JSON: {shorten(text, 100)}"
        if "deviation" in line:
            result.deviations.append(Deviation(**line["deviation"]))
        elif "note" in line:
            result.notes.append(Note(**line["note"]))
        elif "fault" in line:
            result.fault, result.log, result.out_of_memory = line["fault"], line["log"], line["out_of_memory"]
        elif "end" in line:
            result.seconds = line["seconds"]
            return None


def _forward_lines(stdout: IO[str], lines: "queue.Queue[str | None]") -> None:
    for line in stdout:
        lines.put(line)
    lines.put(None)


def _exit_reason(process: "subprocess.Popen[str]", errors: IO[str]) -> str:
    """Return the reason why a process exited: its signal or exit code and the last line of its output."""
    try:
        code = process.wait(EXIT_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return "closes its output but does not exit"
    errors.seek(0)
    output_lines = [line.strip() for line in errors.read().splitlines() if line.strip()]
    last_line = f" ({shorten(output_lines[-1], 300)})" if output_lines else ""
    if code < 0:
        return f"the runtime crashes with {signal_name(code)}{last_line}"
    return f"the process exits with code {code}{last_line}"
