"""A report as one page that opens offline, to be attached to a bug report."""

import errno
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from clsplat.conformance.comparison import Figure
from clsplat.conformance.host import system
from clsplat.conformance.report import GIB, DeviceReport, summary
from clsplat.conformance.supervision import Result
from clsplat.files import told_as, write_text
from clsplat.pages.page import duration, render
from clsplat.results import check_result


@dataclass(frozen=True)
class Row:
    """One check in a table."""

    result: Result
    worst: Figure | None  # the figure nearest to its bound, or furthest beyond it

    @property
    def share(self) -> str:
        """The worst figure by its bound."""
        if self.worst is None:
            return ""
        if self.worst.counts:
            return "exact" if self.worst.value == 0 else f"{self.worst.value:g} wrong"
        return f"{100 * self.worst.value / self.worst.bound:.0f} %"


def check_place(out: Path) -> None:
    """Raise ConfigError for a file of another kind or of a run, OutputError where a page cannot be written."""
    check_result(out, ".html")
    with told_as(out):
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
        parts={name: (summary(results), [_row(result) for result in results]) for name, results in parts.items()},
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
        "took": duration(report.seconds),
    }
    if training:
        first, last = training["losses"]
        text = f"{training['steps']} steps, {training['gaussians']} Gaussians, loss {first:.4f} → {last:.4f}"
        facts["training"] = text
    return facts


def _row(result: Result) -> Row:
    return Row(result, max(result.figures, key=_excess, default=None))


def _excess(figure: Figure) -> float:
    """How far a figure is towards its bound; NaN and wrong counts are beyond all."""
    if not figure.holds:
        return float("inf")
    return figure.value / figure.bound if figure.bound else 0.0
