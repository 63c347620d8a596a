"""Run all checks on a device, with each schedule that it supports, in child processes, and report a verdict."""

import errno
import logging
import math
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from clsplat.conformance.check import Deviation
from clsplat.conformance.checks import KERNELS, SPEED_CHECKS, TILED
from clsplat.conformance.host import describe_host
from clsplat.conformance.quick import forget, remember
from clsplat.conformance.supervision import CheckResult, run_checks
from clsplat.core.errors import pluralize
from clsplat.core.files import check_result_path, raising_output_error, write_text
from clsplat.core.page import duration_text, render
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import SCHEDULES, DeviceInfo, choose_device, resolve_schedule
from clsplat.opencl.kernel_caches import kernel_caches

BITONIC = {"fill_tiles", "sort_tiles", "merge_runs"}  # kernels that `rasterizer.sort: radix` does not use
REPORT = "report the failure, and attach the page that `clsplat doctor --html FILE` writes"
REMEDY = f"update the device's driver or use another device (`clsplat devices` lists them), and {REPORT}"


@dataclass(frozen=True)
class Verdict:
    """The verdict on a device: whether it is usable, a sentence about it, and advice."""

    usable: bool
    text: str
    advice: str = ""  # what to do about the failures

    @property
    def level(self) -> Literal["ready", "warning", "error"]:
        return "error" if not self.usable else "warning" if self.advice else "ready"


def judge(
    default: str, schedules: Mapping[str, Sequence[CheckResult]], device_results: Sequence[CheckResult]
) -> Verdict:
    """Return the verdict on a device from the results of each schedule, and of the checks that run once per device.

    default: the schedule that the device uses by default.  device_results: results of the checks that run once.
    """
    verdict = _judge_failures(default, schedules, device_results)
    if verdict.usable and any(
        result.damaged_cache for results in (*schedules.values(), device_results) for result in results
    ):
        advice = f"remove {kernel_caches()}, and try again" + (f"; {verdict.advice}" if verdict.advice else "")
        return Verdict(True, f"{verdict.text}; its cache of built kernels is damaged", advice)
    return verdict


def _judge_failures(
    default: str, schedules: Mapping[str, Sequence[CheckResult]], device_results: Sequence[CheckResult]
) -> Verdict:
    failures = {name: [text for result in results for text in result.failures] for name, results in schedules.items()}
    other_failures = [text for result in device_results for text in result.failures]
    passing_schedules = [name for name, texts in failures.items() if not texts]
    if passing_schedules and (default in passing_schedules or default not in failures):
        return _judge_default(failures, other_failures)
    if passing_schedules:
        reason = f"with the {default} schedule, {failures[default][0]}"
        return Verdict(True, f"use it with --set rasterizer.schedule={passing_schedules[0]}: {reason}", REMEDY)
    failed_results = [result for result in schedules[default] if not result.passes]
    if all(_is_bitonic(result) for result in failed_results):
        return Verdict(True, f"use it with --set rasterizer.sort=radix: {failures[default][0]}", REMEDY)
    first, more_count = failures[default][0], sum(map(len, failures.values())) - 1
    more_text = f"; {pluralize(more_count, 'more failure')}" if more_count else ""
    return Verdict(False, f"do not use it: {first}{more_text}", REMEDY)


def _judge_default(failures: Mapping[str, list[str]], other_failures: list[str]) -> Verdict:
    faults = [f"with the {name} schedule, {texts[0]}" for name, texts in failures.items() if texts] + other_failures
    if not faults:
        return Verdict(True, "use it")
    return Verdict(True, f"use it; this failure does not affect training: {faults[0]}", REPORT)


def _is_bitonic(result: CheckResult) -> bool:
    return result.fault is None and all(
        deviation.kernel in BITONIC for deviation in result.deviations if not deviation.passes
    )


SCHEMA = 2  # version of the keys in `data`
MAX_FAILURES = 12  # lines of the text
GIB = 2**30


@dataclass
class DeviceReport:
    """The check results of a device, by schedule, from which `verdict` is derived."""

    info: DeviceInfo
    default: str  # the default schedule
    schedules: dict[str, list[CheckResult]] = field(default_factory=dict)
    device_results: list[CheckResult] = field(default_factory=list)  # memory and speed, only with the default schedule
    seconds: float = 0.0

    @property
    def verdict(self) -> Verdict:
        return judge(self.default, self.schedules, self.device_results)

    @property
    def usable(self) -> bool:
        """Whether the device computes correctly with at least one schedule."""
        return self.verdict.usable

    @property
    def failures(self) -> dict[str, list[str]]:
        """A sentence for each failure, by schedule; failures of memory and speed have the key ''."""
        by_schedule = {**self.schedules, "": self.device_results}
        return {name: [text for result in results for text in result.failures] for name, results in by_schedule.items()}

    def note(self, name: str) -> dict[str, Any] | None:
        """Return the data of the note named `name`, or None if no check reported it."""
        for result in (*self.device_results, *self.schedules.get(self.default, [])):
            for note in result.notes:
                if note.name == name:
                    return note.data
        return None

    def data(self) -> dict[str, Any]:
        """Return the report as plain data, with None for values that are not finite."""
        verdict = self.verdict
        return {
            "schema": SCHEMA,
            "verdict": {"usable": verdict.usable, "text": verdict.text, "advice": verdict.advice},
            "device": {**asdict(self.info), "schedule": self.default},
            "host": describe_host(),
            "schedules": {name: [_to_plain(result) for result in results] for name, results in self.schedules.items()},
            "once": [_to_plain(result) for result in self.device_results],
            "seconds": round(self.seconds, 1),
        }

    def text(self) -> str:
        """Return the summary, a few lines of text."""
        verdict, lines = self.verdict, [f"device    {self.info.label}, driver {self.info.driver}"]
        for name, results in self.schedules.items():
            lines.append(f"{name:<9} {summary(results)}")
            lines += _failure_lines(self.failures[name])
        lines += [f"{name:<9} {text}" for name, text in (("memory", self.memory()), ("speed", self.speed())) if text]
        lines += _failure_lines(self.failures[""])
        lines.append(f"verdict   {verdict.text}")
        if verdict.advice:
            lines.append(f"advice    {verdict.advice}")
        return "\n".join(lines)

    def memory(self) -> str:
        """Return the size of the largest buffer that was tested, as a sentence; '' if none was tested."""
        note = self.note("memory")
        if note is None:
            return ""
        sizes = f"{note['held'] / GIB:.2f} GiB of the {note['promised'] / GIB:.2f} GiB that one buffer may have"
        return f"wrote and read {sizes}; {note['stopped']}"

    def speed(self) -> str:
        """Return the time of a step and the peaks of the device, as a sentence; '' if they were not measured."""
        note = self.note("speed")
        if note is None:
            return ""
        width, height, count = note["scene"]
        ratio, peaks = note["step"] / sum(note["floors"].values()), note["peaks"]
        return (
            f"{note['step']:.1f} ms per step with {count:,} Gaussians at {width} x {height} px, {ratio:.1f} times the "
            f"minimum for {peaks['gflops']:.0f} GFLOP/s and {peaks['gbytes']:.1f} GB/s"
        )


def summary(results: list[CheckResult]) -> str:
    """Return the number of checks, comparisons, and failures, as a sentence."""
    deviations = [deviation for result in results for deviation in result.deviations]
    failure_count = sum(not deviation.passes for deviation in deviations)
    fault_count = sum(result.fault is not None for result in results)
    seconds = sum(result.seconds for result in results)
    problems = [f"{failure_count} failed"] if failure_count else []
    problems += [f"{pluralize(fault_count, 'check')} could not be completed"] if fault_count else []
    outcome = " and ".join(problems) or "all passed"
    return f"{len(results)} checks, {len(deviations)} comparisons: {outcome} ({seconds:.0f} s)"


def _failure_lines(failures: list[str]) -> list[str]:
    more_count = len(failures) - MAX_FAILURES
    lines = [f"          {text}" for text in failures[:MAX_FAILURES]]
    return [*lines, f"          … and {more_count} more"] if more_count > 0 else lines


def _to_plain(result: CheckResult) -> dict[str, Any]:
    deviations = [
        {
            **asdict(deviation),
            "value": deviation.value if math.isfinite(deviation.value) else None,
            "passes": deviation.passes,
        }
        for deviation in result.deviations
    ]
    return {**asdict(result), "deviations": deviations, "passes": result.passes}


LOG = logging.getLogger("clsplat")


def examine(device: str | Device | None = None) -> DeviceReport:
    """Run all checks on a device; None chooses the default one.  Raises DeviceError if no device works."""
    info = device.info if isinstance(device, Device) else choose_device(device)
    default = resolve_schedule(info, "auto")
    report, start_time = DeviceReport(info, default), time.perf_counter()
    LOG.info("checking %s; this takes a minute or two on a CPU", info.label)
    for schedule in SCHEDULES:
        if not _is_due(schedule, report):
            continue
        results = report.schedules[schedule] = []
        checks = TILED if schedule == "simt16" and not report.failures["simt"] else KERNELS
        for result in run_checks(info, schedule, checks):
            results.append(result)
            LOG.info("%s", progress_line(schedule, result))
        if all(result.passes and not result.damaged_cache for result in results):
            remember(info, schedule)
        else:
            forget(info, schedule)
    for result in run_checks(info, default, SPEED_CHECKS):
        report.device_results.append(result)
        LOG.info("%s", progress_line("", result))
    report.seconds = time.perf_counter() - start_time
    return report


def _is_due(schedule: str, report: DeviceReport) -> bool:
    """Return whether to check a schedule: `simt` always, `wide` if it is the default or a CPU fails with `simt`.

    Other devices do not benefit from `wide`, and some compilers need many minutes for its vectors.
    """
    if schedule == "simt16":
        return report.info.group >= 256  # one work-item for each pixel of a tile
    if schedule == "simt" or report.default == "wide":
        return True
    return report.info.kind == "CPU" and bool(report.failures["simt"])


def progress_line(schedule: str, result: CheckResult) -> str:
    """Return the log line of one check."""
    failures = result.failures
    count = len(result.deviations)
    success = f"{pluralize(count, 'comparison')} passed" if count else "measured"
    outcome = f"WRONG: {failures[0]}" if failures else success
    return f"  {f'{schedule:<7}{result.name}':<56}{result.seconds:5.1f} s  {outcome}"


# The report as an HTML page that opens offline, to attach to a bug report.


def check_html_path(out: Path) -> None:
    """Raise ConfigError if a path is not an .html file or belongs to a run, OutputError if it cannot be written."""
    check_result_path(out, ".html")
    with raising_output_error(out):
        if out.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out.parent):
            pass


def write_page(report: DeviceReport, out: Path) -> None:
    """Write the report as an HTML page.  Raises OutputError."""
    write_text(out, report_page(report))


def report_page(report: DeviceReport) -> str:
    """Return the report as an HTML page."""
    verdict = report.verdict
    sections = {f"The {name} schedule": results for name, results in report.schedules.items()}
    sections |= {"Memory and speed": report.device_results}
    return render(
        "doctor.html.j2",
        title=f"Doctor: {report.info.name}",
        subtitle=f"{report.info.platform}, driver {report.info.driver}",
        level=verdict.level,
        verdict=verdict.text[0].upper() + verdict.text[1:],
        advice=verdict.advice,
        failures=[(name or "once", text) for name, texts in report.failures.items() for text in texts],
        facts=_facts(report),
        parts={
            name: (summary(results), [(result, largest_error(result)) for result in results])
            for name, results in sections.items()
        },
        speed=report.note("speed"),
        speed_text=report.speed(),
        logs=[(name, result) for name, results in sections.items() for result in results if result.log],
    )


def _facts(report: DeviceReport) -> dict[str, str]:
    info, host = report.info, describe_host()
    training = report.note("training")
    facts = {
        "device": f"{info.name}, {info.kind}, {info.units} compute units",
        "runtime": info.platform,
        "driver": info.driver,
        "limits": f"{info.memory / GIB:.1f} GiB, buffers up to {info.allocation / GIB:.1f} GiB, work-groups up to "
        f"{info.group}, {info.local_memory >> 10} KiB of local memory, vectors of {info.float_width} floats",
        "default schedule": report.default,
        "memory": report.memory(),
        "clsplat": host["clsplat"],
        "system": f"{host['system']}, {host['processors']} processors",
        "Python": f"{host['python']}, NumPy {host['numpy']}",
        "environment": ", ".join(f"{name}={value}" for name, value in host["environment"].items()) or "none set",
        "duration": duration_text(report.seconds),
    }
    if training:
        first, last = training["losses"]
        text = f"{training['steps']} steps, {training['gaussians']} Gaussians, loss {first:.4f} → {last:.4f}"
        facts["training"] = text
    return facts


def largest_error(result: CheckResult) -> str:
    """Return the largest deviation relative to its bound, as text."""
    worst = max(result.deviations, key=_bound_ratio, default=None)
    if worst is None:
        return ""
    if worst.counts:
        return "exact" if worst.value == 0 else f"{worst.value:g} wrong"
    return f"{100 * worst.value / worst.bound:.0f} %"


def _bound_ratio(deviation: Deviation) -> float:
    """Return a deviation divided by its bound; infinity if it exceeds the bound or is NaN."""
    if not deviation.passes:
        return float("inf")
    return deviation.value / deviation.bound if deviation.bound else 0.0
