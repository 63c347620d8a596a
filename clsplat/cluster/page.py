"""The state of a store as one page that opens offline."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.files import write_text
from clsplat.pages.page import duration, render

LEVELS = {"published": "ready", "running": "note", "failed": "error", "silent": "warning", "stopped": "warning"}
ORDER = ("published", "running", "waiting", "stopped", "silent", "failed")


@dataclass(frozen=True)
class Row:
    """A cell in the table."""

    cell: dict[str, Any]

    @property
    def level(self) -> str:
        """Which colour its state has."""
        return LEVELS.get(self.cell["state"], "")

    @property
    def name(self) -> str:
        """Its name, or that of its pipeline."""
        return str(self.cell["name"] or f"{self.cell['pipeline']} seed={self.cell['seed']}")

    @property
    def place(self) -> str:
        """The device that runs it, or has, and the machine."""
        return " · ".join(str(self.cell[key]) for key in ("device", "host") if self.cell.get(key))

    @property
    def done(self) -> int:
        """Steps done."""
        return self.cell.get("step") or 0

    @property
    def quality(self) -> str:
        """PSNR of the result."""
        return f"{self.cell['psnr']:.2f}" if "psnr" in self.cell else ""

    @property
    def took(self) -> str:
        """How long it took, or what is left."""
        seconds, left = self.cell.get("seconds"), self.cell.get("seconds_left")
        if isinstance(seconds, int | float):
            return duration(seconds)
        is_known = self.cell["state"] == "running" and isinstance(left, int | float)
        return f"{duration(left)} left" if is_known and left is not None else ""

    @property
    def remark(self) -> str:
        """Why it failed, or for how long nothing was heard of it."""
        if self.cell["state"] == "silent":
            return f"no sign of life for {duration(self.cell['silent'])}"
        return str(self.cell.get("message") or "")


def write_page(found: dict[str, Any], out: Path) -> None:
    """Write what `store_status` returned.  Raises OutputError when that fails."""
    write_text(out, store_page(found))


def store_page(found: dict[str, Any]) -> str:
    """Return the page."""
    counts, cells = found["counts"], found["cells"]
    known = [state for state in ORDER if state in counts]
    verdict = ", ".join(f"{counts[state]} {state}" for state in [*known, *sorted(counts.keys() - {*ORDER})])
    is_done = counts.get("published", 0) == len(cells) > 0
    return render(
        "store.html.j2",
        title=f"{Path(found['store']).resolve().name}: cells of sweeps",
        subtitle=f"{found['store']}, {time.strftime('%Y-%m-%d %H:%M:%S', time.gmtime(found['time']))} UTC",
        level="error" if "failed" in counts else "ready" if is_done else "note",
        verdict=f"{len(cells)} cells: {verdict}" if cells else "no cells",
        rows=[Row(cell) for cell in cells],
        events=found["events"],
    )
