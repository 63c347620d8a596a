"""A report of all checks of one device, as data, text and a page."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

from clsplat.conformance.host import system
from clsplat.conformance.supervision import Result
from clsplat.conformance.verdict import Verdict, judge
from clsplat.opencl.discovery import DeviceInfo

SCHEMA = 1  # of `data`; a larger one may have other keys
MAX_FAILURES = 12  # lines of the text
GIB = 2**30


@dataclass
class DeviceReport:
    """What `clsplat.doctor` returns."""

    info: DeviceInfo
    default: str  # schedule
    schedules: dict[str, list[Result]] = field(default_factory=dict)
    once: list[Result] = field(default_factory=list)  # memory and speed
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


def summary(results: list[Result]) -> str:
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


def _plain(result: Result) -> dict[str, Any]:
    figures = [
        {**asdict(figure), "value": figure.value if math.isfinite(figure.value) else None, "holds": figure.holds}
        for figure in result.figures
    ]
    return {**asdict(result), "figures": figures, "holds": result.holds}
