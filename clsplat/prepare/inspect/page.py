"""Write an inspection as an HTML page that opens offline, with verdict, findings, facts, cameras and points."""

from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from clsplat.core.errors import pluralize
from clsplat.core.files import write_text
from clsplat.core.page import mark_charts_safe, render
from clsplat.prepare.inspect.findings import Inspection, summarize
from clsplat.scene.points import MAX_VALUE
from clsplat.viewer.charts import camera_plans, histogram

MAX_NAMES = 200  # names per list
MAX_VIEWS = 8  # rows of the table of views with the lowest point counts


def write_page(inspection: Inspection, out: Path) -> None:
    """Write an inspection to the HTML file `out`.  Raises OutputError if that fails."""
    write_text(out, inspection_page(inspection))


def inspection_page(inspection: Inspection) -> str:
    """Return the page of an inspection as HTML."""
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
        facts=summarize(inspection.facts),
        cameras=_draw_cameras(inspection),
        far=pluralize(len(inspection.facts.outlier_cameras), "camera") if inspection.facts.outlier_cameras else "",
        points_per_view=_draw_points_per_view(inspection),
        lists=_name_lists(inspection),
    )


def _draw_cameras(inspection: Inspection) -> list[Markup]:
    """Draw the cameras without outliers, and the points, from above and from the side."""
    outliers, scene, table = set(inspection.facts.outlier_cameras), inspection.parts.scene, inspection.parts.points
    test_names = {view.name for view in scene.split("test")} if scene else set()
    inliers = [view for view in inspection.parts.views if view.name not in outliers]
    views = {
        "training": [view for view in inliers if view.name not in test_names],
        "test": [view for view in inliers if view.name in test_names],
    }
    points: NDArray[np.floating] = np.empty((0, 3)) if table is None else table.positions
    finite = points[(np.abs(points) < MAX_VALUE).all(axis=1)]
    return mark_charts_safe(camera_plans(views, finite))


def _draw_points_per_view(inspection: Inspection) -> tuple[list[Markup], list[tuple[str, int]]] | None:
    """Draw the histogram of points per view, and list the views with the lowest counts.  None if they are unknown."""
    counts = inspection.facts.points_per_view
    if not counts:
        return None
    lowest = sorted(counts.items(), key=lambda item: item[1])[:MAX_VIEWS]
    return mark_charts_safe([histogram("number of points per view", list(counts.values()))]), lowest


def _name_lists(inspection: Inspection) -> list[tuple[str, list[str], int]]:
    """Return the lists of names on the page, each with its title, up to MAX_NAMES names, and the total count."""
    facts, photographs = inspection.facts, inspection.facts.photos
    lists = {
        "registered but missing from disk": facts.missing,
        "on disk but without a pose": facts.unregistered,
        "cannot be read": [f"{name}: {reason}" for name, reason in photographs.unreadable.items()],
        "not the size of the camera": [f"{name}: {size}" for name, size in photographs.misfits.items()],
        "end of the file is missing": photographs.cut,
        "rotated by EXIF": photographs.exif_turned,
        "far away from all others": facts.outlier_cameras,
        "same pose": [" = ".join(names) for names in facts.same_pose],
        "few points": facts.few_points,
    }
    return [(title, names[:MAX_NAMES], len(names)) for title, names in lists.items() if names]
