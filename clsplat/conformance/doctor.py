"""Prove a device: all checks, with each schedule that it takes, in processes of their own."""

import logging
import time
from typing import Literal

from clsplat.conformance.checks import KERNELS, SPEED
from clsplat.conformance.quick import forget, remember
from clsplat.conformance.report import DeviceReport
from clsplat.conformance.supervision import Result, supervised
from clsplat.errors import amount
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import choose, resolve_schedule

LOG = logging.getLogger("clsplat")
SCHEDULES: tuple[Literal["simt", "wide"], ...] = ("simt", "wide")


def examine(device: str | Device | None = None) -> DeviceReport:
    """Run all checks on a device, or on the one of a name.  Raises DeviceError where there is none that works."""
    info = device.info if isinstance(device, Device) else choose(device)
    default = resolve_schedule(info, "auto")
    report, started = DeviceReport(info, default), time.perf_counter()
    LOG.info("device: %s; this takes a minute or two on a CPU", info.text)
    for schedule in SCHEDULES:
        if not _is_due(schedule, report):
            continue
        results = report.schedules[schedule] = []
        for result in supervised(info, schedule, KERNELS):
            results.append(result)
            LOG.info("%s", progress(schedule, result))
        if all(result.holds and not result.damaged_cache for result in results):
            remember(info, schedule)
        else:
            forget(info, schedule)
    for result in supervised(info, default, SPEED):
        report.once.append(result)
        LOG.info("%s", progress("", result))
    report.seconds = time.perf_counter() - started
    return report


def _is_due(schedule: str, report: DeviceReport) -> bool:
    """simt runs everywhere; wide where it is the default, and on a CPU that computes wrongly with simt.

    Elsewhere nobody would use it, and some compilers take many minutes for its vectors.
    """
    if schedule == "simt" or report.default == "wide":
        return True
    return report.info.kind == "CPU" and bool(report.failures["simt"])


def progress(schedule: str, result: Result) -> str:
    """Return a line for one check."""
    failures = result.failures
    words = f"WRONG: {failures[0]}" if failures else _hold(len(result.figures))
    return f"  {f'{schedule:<5}{result.name}':<54}{result.seconds:5.1f} s  {words}"


def _hold(figures: int) -> str:
    if figures == 0:
        return "measured"
    return f"{amount(figures, 'figure')} hold{'s' if figures == 1 else ''}"
