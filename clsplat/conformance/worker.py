"""Run checks on the device of two numbers, in a process of its own, and print what they find: one line of JSON each.

A runtime may abort the process: the check of the next line is then the one that it ended.
"""

import json
import os
import sys
import time
from dataclasses import asdict
from typing import Any, TextIO

from clsplat.conformance.check import Check, Note
from clsplat.conformance.checks import BY_NAME
from clsplat.errors import ClsplatError, KernelError, MemoryLimitError, as_clsplat_error, one_line, shortened
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import Schedule, list_devices

LOG_LIMIT = 4000  # characters of a build log


def main(platform: int, number: int, schedule: Schedule, names: list[str]) -> None:
    """Open the device and run the checks of these names."""
    out = _only_writer_of_stdout()
    info = next(info for info in list_devices() if info.place == (platform, number))
    device = Device(info, schedule)
    for name in names:
        started = time.perf_counter()
        _run(out, BY_NAME[name], device)
        _print(out, end=name, seconds=round(time.perf_counter() - started, 3))


def _run(out: TextIO, check: Check, device: Device) -> None:
    try:
        for found in check.figures(device):
            if isinstance(found, Note):
                _print(out, note=asdict(found))
            else:
                _print(out, figure=asdict(found))
    except Exception as error:  # a finding about the device, not the end of the checks
        what = one_line(error) if isinstance(error, ClsplatError) else f"{type(error).__name__}: {one_line(error)}"
        log = str(error.__cause__)[:LOG_LIMIT] if isinstance(error, KernelError) and error.__cause__ else ""
        _print(
            out,
            fault=shortened(what, 600),
            log=log,
            out_of_memory=isinstance(as_clsplat_error(error), MemoryLimitError),
        )


def _only_writer_of_stdout() -> TextIO:
    """Return stdout, and send what runtimes print there to stderr from here on."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return out


def _print(out: TextIO, **line: Any) -> None:
    out.write(json.dumps(line, default=float) + "\n")
    out.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4:])  # type: ignore[arg-type]
