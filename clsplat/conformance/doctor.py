"""Prove a device: all checks, with each schedule that it takes, in processes of their own."""

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

from clsplat.conformance.check import Figure
from clsplat.conformance.checks import KERNELS, SPEED
from clsplat.conformance.host import system
from clsplat.conformance.quick import forget, remember
from clsplat.conformance.supervision import CheckResult, supervised
from clsplat.core.errors import pluralize
from clsplat.core.files import check_result_path, raising_output_error, write_text
from clsplat.core.page import duration_text, render
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import DeviceInfo, choose, resolve_schedule
from clsplat.opencl.kernel_caches import kernel_caches

# The verdict on a device, in words.

BITONIC = {"count_pairs", "fill_tiles", "sort_tiles"}  # what `rasterizer.sort: radix` does without
REPORT = "report it with the file of `clsplat doctor --html FILE`"
REMEDY = f"update the device's driver or take another device (`clsplat devices` lists them), and {REPORT}"


@dataclass(frozen=True)
class Verdict:
    """Whether to use a device, and how."""

    usable: bool
    text: str
    advice: str = ""  # what to do about what is wrong

    @property
    def level(self) -> Literal["ready", "warning", "error"]:
        return "error" if not self.usable else "warning" if self.advice else "ready"


def judge(default: str, schedules: Mapping[str, Sequence[CheckResult]], once: Sequence[CheckResult]) -> Verdict:
    """Judge the results of each schedule, and of the checks that a device needs `once`."""
    verdict = _of_figures(default, schedules, once)
    if verdict.usable and any(result.damaged_cache for part in (*schedules.values(), once) for result in part):
        advice = f"remove {kernel_caches()}, which fill again" + (f"; {verdict.advice}" if verdict.advice else "")
        return Verdict(True, f"{verdict.text}, once its cache of built kernels, which is damaged, is removed", advice)
    return verdict


def _of_figures(default: str, schedules: Mapping[str, Sequence[CheckResult]], once: Sequence[CheckResult]) -> Verdict:
    failures = {name: [text for result in results for text in result.failures] for name, results in schedules.items()}
    others = [text for result in once for text in result.failures]
    good = [name for name, found in failures.items() if not found]
    if good and (default in good or default not in failures):
        return _with_the_default(good, failures, others)
    if good:
        why = f"with the {default} schedule, {failures[default][0]}"
        return Verdict(True, f"use it with --set rasterizer.schedule={good[0]}: {why}", REMEDY)
    wrong = [result for result in schedules[default] if not result.holds]
    if all(_is_bitonic(result) for result in wrong):
        return Verdict(True, f"use it with --set rasterizer.sort=radix: {failures[default][0]}", REMEDY)
    first, more = failures[default][0], sum(map(len, failures.values())) - 1
    rest = f"; {more} more {'is' if more == 1 else 'are'} wrong" if more else ""
    return Verdict(False, f"do not use it: {first}{rest}", REMEDY)


def _with_the_default(good: list[str], failures: Mapping[str, list[str]], others: list[str]) -> Verdict:
    wrong = [f"with the {name} schedule, {found[0]}" for name, found in failures.items() if found] + others
    if not wrong:
        return Verdict(True, "use it")
    return Verdict(True, f"use it, as it is; but {wrong[0]}", f"nothing for training; {REPORT}")


def _is_bitonic(result: CheckResult) -> bool:
    return result.fault is None and all(figure.kernel in BITONIC for figure in result.figures if not figure.holds)


# A report of all checks of one device, as data, text and a page.

SCHEMA = 1  # of `data`; a larger one may have other keys
MAX_FAILURES = 12  # lines of the text
GIB = 2**30


@dataclass
class DeviceReport:
    """What `clsplat.doctor` returns."""

    info: DeviceInfo
    default: str  # schedule
    schedules: dict[str, list[CheckResult]] = field(default_factory=dict)
    once: list[CheckResult] = field(default_factory=list)  # memory and speed
    seconds: float = 0.0

    @property
    def verdict(self) -> Verdict:
        return judge(self.default, self.schedules, self.once)

    @property
    def usable(self) -> bool:
        """Whether the device computes what the reference says, with at least one schedule."""
        return self.verdict.usable

    @property
    def failures(self) -> dict[str, list[str]]:
        """A sentence for everything that is wrong, by schedule; memory and speed under ''."""
        parts = {**self.schedules, "": self.once}
        return {name: [text for result in part for text in result.failures] for name, part in parts.items()}

    def note(self, name: str) -> dict[str, Any] | None:
        """Return what a check noted under a name, with the default schedule or once."""
        for result in (*self.once, *self.schedules.get(self.default, [])):
            for note in result.notes:
                if note.name == name:
                    return note.data
        return None

    def data(self) -> dict[str, Any]:
        """Return everything as plain data; a value that is not finite is None."""
        verdict = self.verdict
        return {
            "schema": SCHEMA,
            "verdict": {"usable": verdict.usable, "text": verdict.text, "advice": verdict.advice},
            "device": {**asdict(self.info), "schedule": self.default},
            "host": system(),
            "schedules": {name: [_plain(result) for result in results] for name, results in self.schedules.items()},
            "once": [_plain(result) for result in self.once],
            "seconds": round(self.seconds, 1),
        }

    def text(self) -> str:
        """Return the summary as lines."""
        verdict, lines = self.verdict, [f"device    {self.info.text}, driver {self.info.driver}"]
        for name, results in self.schedules.items():
            lines.append(f"{name:<9} {summary(results)}")
            lines += _listed(self.failures[name])
        lines += [f"{name:<9} {text}" for name, text in (("memory", self.memory()), ("speed", self.speed())) if text]
        lines += _listed(self.failures[""])
        lines.append(f"verdict   {verdict.text}")
        if verdict.advice:
            lines.append(f"advice    {verdict.advice}")
        return "\n".join(lines)

    def memory(self) -> str:
        """Return the largest buffer that was written, in words."""
        found = self.note("memory")
        if found is None:
            return ""
        sizes = f"{found['held'] / GIB:.2f} GiB of the {found['promised'] / GIB:.2f} GiB that one buffer may have"
        return f"wrote and read {sizes}; {found['stopped']}"

    def speed(self) -> str:
        """Return the time of a step and the peaks, in words."""
        found = self.note("speed")
        if found is None:
            return ""
        width, height, count = found["scene"]
        ratio, peaks = found["step"] / sum(found["floors"].values()), found["peaks"]
        return (
            f"{found['step']:.1f} ms a step of {count:,} Gaussians at {width} x {height} px, {ratio:.1f} times the "
            f"least for {peaks['gflops']:.0f} GFLOP/s and {peaks['gbytes']:.1f} GB/s"
        )


def summary(results: list[CheckResult]) -> str:
    """Return the number of checks and figures, and of those that do not hold."""
    figures = [figure for result in results for figure in result.figures]
    wrong = sum(not figure.holds for figure in figures)
    stopped = sum(result.fault is not None for result in results)
    seconds = sum(result.seconds for result in results)
    words = [f"{wrong} do not hold"] if wrong else []
    words += [f"{stopped} checks could not be completed"] if stopped else []
    return f"{len(results)} checks, {len(figures)} figures: {' and '.join(words) or 'all hold'} ({seconds:.0f} s)"


def _listed(failures: list[str]) -> list[str]:
    more = len(failures) - MAX_FAILURES
    lines = [f"          {text}" for text in failures[:MAX_FAILURES]]
    return [*lines, f"          … and {more} more"] if more > 0 else lines


def _plain(result: CheckResult) -> dict[str, Any]:
    figures = [
        {**asdict(figure), "value": figure.value if math.isfinite(figure.value) else None, "holds": figure.holds}
        for figure in result.figures
    ]
    return {**asdict(result), "figures": figures, "holds": result.holds}


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


def progress(schedule: str, result: CheckResult) -> str:
    """Return a line for one check."""
    failures = result.failures
    count = len(result.figures)
    holds = f"{pluralize(count, 'figure')} hold{'s' if count == 1 else ''}" if count else "measured"
    words = f"WRONG: {failures[0]}" if failures else holds
    return f"  {f'{schedule:<5}{result.name}':<54}{result.seconds:5.1f} s  {words}"


# A report as one page that opens offline, to be attached to a bug report.


def check_place(out: Path) -> None:
    """Raise ConfigError for a file of another kind or of a run, OutputError where a page cannot be written."""
    check_result_path(out, ".html")
    with raising_output_error(out):
        if out.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out.parent):
            pass


def write_page(report: DeviceReport, out: Path) -> None:
    """Write the page.  Raises OutputError when that fails."""
    write_text(out, report_page(report))


def report_page(report: DeviceReport) -> str:
    """Return the page."""
    verdict = report.verdict
    parts = {f"The {name} schedule": results for name, results in report.schedules.items()}
    parts |= {"Memory and speed": report.once}
    return render(
        "doctor.html.j2",
        title=f"Doctor: {report.info.name}",
        subtitle=f"{report.info.platform}, driver {report.info.driver}",
        level=verdict.level,
        verdict=verdict.text[0].upper() + verdict.text[1:],
        advice=verdict.advice,
        failures=[(name or "once", text) for name, found in report.failures.items() for text in found],
        facts=_facts(report),
        parts={
            name: (summary(results), [(result, worst(result)) for result in results]) for name, results in parts.items()
        },
        speed=report.note("speed"),
        speed_text=report.speed(),
        logs=[(name, result) for name, results in parts.items() for result in results if result.log],
    )


def _facts(report: DeviceReport) -> dict[str, str]:
    info, host = report.info, system()
    training = report.note("training")
    facts = {
        "device": f"{info.name}, {info.kind}, {info.units} units",
        "runtime": info.platform,
        "driver": info.driver,
        "limits": f"{info.memory / GIB:.1f} GiB, buffers up to {info.allocation / GIB:.1f} GiB, groups up to "
        f"{info.group}, {info.local_memory >> 10} KiB local, {info.float_width} lanes",
        "schedule by default": report.default,
        "memory": report.memory(),
        "clsplat": host["clsplat"],
        "system": f"{host['system']}, {host['processors']} processors",
        "Python": f"{host['python']}, NumPy {host['numpy']}",
        "environment": ", ".join(f"{name}={value}" for name, value in host["environment"].items()) or "nothing set",
        "took": duration_text(report.seconds),
    }
    if training:
        first, last = training["losses"]
        text = f"{training['steps']} steps, {training['gaussians']} Gaussians, loss {first:.4f} → {last:.4f}"
        facts["training"] = text
    return facts


def worst(result: CheckResult) -> str:
    """Return the figure nearest to its bound, or furthest beyond it, by its bound."""
    found = max(result.figures, key=_excess, default=None)
    if found is None:
        return ""
    if found.counts:
        return "exact" if found.value == 0 else f"{found.value:g} wrong"
    return f"{100 * found.value / found.bound:.0f} %"


def _excess(figure: Figure) -> float:
    """How far a figure is toward its bound; NaN and wrong counts are beyond all."""
    if not figure.holds:
        return float("inf")
    return figure.value / figure.bound if figure.bound else 0.0
