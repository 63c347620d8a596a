"""An inspection as one page that opens offline: verdict, findings, figures, cameras and points."""

from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from clsplat.files import write_text
from clsplat.inspect.figures import figures
from clsplat.inspect.inspection import Inspection
from clsplat.inspect.space import space
from clsplat.pages.page import charts, render
from clsplat.pages.svg import histogram

MAX_NAMES = 200  # of a list
MAX_VIEWS = 8  # in the table of those that see the fewest points


@dataclass(frozen=True)
class Seen:
    """How many points the views see."""

    charts: list[Markup]
    fewest: list[tuple[str, int]]  # views and their points


@dataclass(frozen=True)
class NameList:
    """The names behind a figure: MAX_NAMES of `count`."""

    title: str
    names: list[str]
    count: int


def write_page(inspection: Inspection, out: Path) -> None:
    """Write the page.  Raises OutputError when that fails."""
    write_text(out, inspection_page(inspection))


def inspection_page(inspection: Inspection) -> str:
    """Return the page."""
    path = inspection.facts.path
    name = path.rstrip("/").rpartition("/")[2] or path
    worst = inspection.findings[0].level if inspection.findings else "note"
    return render(
        "inspect.html.j2",
        title=f"{name}: inspection of the dataset",
        subtitle=path,
        state="ready" if worst == "note" else worst,
        verdict=inspection.verdict[0].upper() + inspection.verdict[1:],
        findings=inspection.findings,
        figures=figures(inspection.facts),
        space=space(inspection),
        seen=_seen(inspection),
        lists=_lists(inspection),
    )


def _seen(inspection: Inspection) -> Seen | None:
    """A histogram, and the views that see the fewest points; None where the dataset has no such counts."""
    seen = inspection.facts.seen
    if not seen:
        return None
    fewest = sorted(seen.items(), key=lambda item: item[1])[:MAX_VIEWS]
    return Seen(charts([histogram("views by their number of points", list(seen.values()))]), fewest)


def _lists(inspection: Inspection) -> list[NameList]:
    facts, photographs = inspection.facts, inspection.facts.photos
    lists = {
        "registered but missing on disk": facts.missing,
        "on disk but without a pose": facts.unregistered,
        "cannot be read": [f"{name}: {reason}" for name, reason in photographs.unreadable.items()],
        "not of the camera's size": [f"{name}: {size}" for name, size in photographs.misfits.items()],
        "end of the file is missing": photographs.cut,
        "rotated by the EXIF data": photographs.exif_turned,
        "far away from all others": facts.strayed,
        "same pose": [" = ".join(names) for names in facts.same_pose],
        "few points": facts.few_seen,
    }
    return [NameList(title, names[:MAX_NAMES], len(names)) for title, names in lists.items() if names]
