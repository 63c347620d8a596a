"""Run checks on a device and print their results as lines of JSON.

Arguments: platform number, device number, schedule, and the names of the checks.  If the OpenCL runtime aborts the
process, the parent knows which check was running.  The process exits when its parent closes stdin or exits.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import cache
from typing import Any, TextIO

from clsplat.conformance.check import Check, Note
from clsplat.conformance.checks import BY_NAME
from clsplat.core.errors import ClsplatError, KernelError, MemoryLimitError, as_clsplat_error, one_line, shorten
from clsplat.core.signals import take_stdin, take_stdout
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import Schedule, list_devices

MAX_LOG = 4000  # characters of a build log


def main(platform: int, number: int, schedule: Schedule, names: list[str]) -> None:
    """Run the checks with these names on a device, which the first check opens."""
    threading.Thread(target=_exit_with_parent, args=(take_stdin(),), daemon=True).start()
    out = take_stdout()
    info = next(info for info in list_devices() if info.index == (platform, number))
    open_once = cache(lambda: Device(info, schedule))
    for name in names:
        start_time = time.perf_counter()
        _run(out, BY_NAME[name], open_once)
        _print(out, end=name, seconds=round(time.perf_counter() - start_time, 3))


def _run(out: TextIO, check: Check, open_once: Callable[[], Device]) -> None:
    try:
        for result in check.deviations(open_once()):
            if isinstance(result, Note):
                _print(out, note=asdict(result))
            else:
                _print(out, deviation=asdict(result))
    except Exception as error:  # a failure of the device; the other checks continue
        fault = one_line(error) if isinstance(error, ClsplatError) else f"{_fault_source(error)}: {one_line(error)}"
        log = str(error.__cause__)[:MAX_LOG] if isinstance(error, KernelError) and error.__cause__ else ""
        _print(
            out,
            fault=shorten(fault, 600),
            log=log,
            out_of_memory=isinstance(as_clsplat_error(error), MemoryLimitError),
        )


def _fault_source(error: Exception) -> str:
    if type(error).__module__.startswith("pyopencl"):
        return "the OpenCL runtime rejects a call"
    return f"the check raises {type(error).__name__}, which may be a bug in clsplat"


def _exit_with_parent(pipe: int) -> None:
    """Exit at once when the parent exits or closes its end of the pipe."""
    while os.read(pipe, 1024):
        pass
    os._exit(1)


def _print(out: TextIO, **line: Any) -> None:
    out.write(json.dumps(line, default=float) + "\n")
    out.flush()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3], sys.argv[4:])  # type: ignore[arg-type]
