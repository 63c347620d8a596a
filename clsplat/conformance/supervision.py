"""Run checks in processes of their own, and go on after one that dies or hangs."""

import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import IO, Any

from clsplat.conformance.check import Check, Figure, Note
from clsplat.core.errors import shorten
from clsplat.opencl.discovery import DeviceInfo
from clsplat.opencl.kernel_caches import empty_kernel_caches

WORKER = ("-P", "-m", "clsplat.conformance.worker")  # -P: nothing of the working folder is imported
CHECK_SECONDS = 900  # without a word from a check; an interpreter of kernels needs minutes
END_SECONDS = 30  # between the end of the output and that of the process, which may write its memory to a file


@dataclass
class CheckResult:
    """What one check found on a device."""

    name: str
    kernels: tuple[str, ...]
    seconds: float = 0.0
    figures: list[Figure] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    fault: str | None = None  # why it could not be completed
    log: str = ""  # of a build that failed
    out_of_memory: bool = False  # the fault is no more than that
    hangs: bool = False  # the fault is that, or an answer that cannot be read
    damaged_cache: bool = False  # there was a fault, and with empty caches of kernels there is none

    @property
    def holds(self) -> bool:
        return self.fault is None and all(figure.holds for figure in self.figures)

    @property
    def failures(self) -> list[str]:
        """A sentence for everything that is wrong."""
        stopped = [f"{self.name}: {shorten(self.fault, 240)}"] if self.fault else []
        return stopped + [figure.text for figure in self.figures if not figure.holds]


def supervised(
    info: DeviceInfo, schedule: str, checks: Sequence[Check], seconds: float = CHECK_SECONDS
) -> Iterator[CheckResult]:
    """Run checks on a device with a schedule; yield each result when it is complete.

    A check that says nothing for `seconds` is stopped.  One that cannot be completed is tried again with empty caches
    of built kernels, until that does not help.
    """
    left, trying = list(checks), True
    while left:
        done = 0
        for result in _one_process(info, schedule, left, seconds):
            if trying and result.fault and not result.out_of_memory and not result.hangs:
                again = _with_empty_caches(info, schedule, left[done], seconds)
                trying = again.fault is None
                result = again if trying else result
            done += 1
            yield result
        left = left[done:]


def _with_empty_caches(info: DeviceInfo, schedule: str, check: Check, seconds: float) -> CheckResult:
    with empty_kernel_caches() as variables:
        (result,) = _one_process(info, schedule, [check], seconds, variables)
    result.damaged_cache = result.fault is None
    return result


def _one_process(
    info: DeviceInfo, schedule: str, checks: Sequence[Check], seconds: float, variables: Mapping[str, str] | None = None
) -> Iterator[CheckResult]:
    """Results of the first checks, up to and including one that ends the process: at least one."""
    command = [sys.executable, *WORKER, *map(str, info.place), schedule]
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
        assert process.stdin is not None  # open until the end, which is the worker's too
        assert process.stdout is not None
        lines: queue.Queue[str | None] = queue.Queue()
        threading.Thread(target=_pump, args=(process.stdout, lines), daemon=True).start()
        try:
            for check in checks:
                result = CheckResult(check.name, check.kernels)
                ended = _fill(result, lines, seconds)
                if ended is not None:
                    result.fault = ended or _death(process, errors)
                    result.hangs = bool(ended)
                yield result
                if ended is not None:
                    return
        finally:
            process.kill()
            process.wait()
            process.stdin.close()


def _fill(result: CheckResult, lines: "queue.Queue[str | None]", seconds: float) -> str | None:
    """Take the lines of one check; None: it is complete, "": the process ended, else why it is stopped."""
    while True:
        try:
            text = lines.get(timeout=seconds)
        except queue.Empty:
            return f"gives no answer for {seconds} s"
        if text is None:
            return ""
        try:
            line: dict[str, Any] = json.loads(text)
        except ValueError:
            return f"ends in the middle of a line: {shorten(text, 100)}"
        if "figure" in line:
            result.figures.append(Figure(**line["figure"]))
        elif "note" in line:
            result.notes.append(Note(**line["note"]))
        elif "fault" in line:
            result.fault, result.log, result.out_of_memory = line["fault"], line["log"], line["out_of_memory"]
        elif "end" in line:
            result.seconds = line["seconds"]
            return None


def _pump(stdout: IO[str], lines: "queue.Queue[str | None]") -> None:
    for line in stdout:
        lines.put(line)
    lines.put(None)


def _death(process: "subprocess.Popen[str]", errors: IO[str]) -> str:
    """Why a process ended: its signal or exit code, and the last line that it wrote."""
    try:
        code = process.wait(END_SECONDS)
    except subprocess.TimeoutExpired:
        return "closes its output, and does not end"
    errors.seek(0)
    written = [line.strip() for line in errors.read().splitlines() if line.strip()]
    last = f" ({shorten(written[-1], 300)})" if written else ""
    if code < 0:
        names = {one.value: one.name for one in signal.Signals}
        return f"the runtime ends the process with {names.get(-code, f'signal {-code}')}{last}"
    return f"the process ends with code {code}{last}"
