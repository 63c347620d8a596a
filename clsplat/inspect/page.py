"""An inspection as one page that opens offline: verdict, findings, figures, cameras and points."""

import html
from pathlib import Path

from clsplat.files import write_text
from clsplat.inspect.figures import figures
from clsplat.inspect.inspection import Inspection
from clsplat.inspect.space import SCRIPT, space
from clsplat.inspect.space import STYLE as SPACE_STYLE
from clsplat.pages.page import page
from clsplat.pages.svg import histogram

LISTED = 200  # names of a list
STYLE = (
    """
.verdict{padding:.7rem 1rem;border-radius:6px;font-size:1.1rem;font-weight:600;overflow-wrap:anywhere}
.ready{background:#e6f6ec;color:#22543d}.warning{background:#fffaf0;color:#9c4221}.error{background:#fff5f5;color:#9b2c2c}
ul.findings{list-style:none;padding:0}ul.findings li{display:flex;gap:.9rem;padding:.35rem 0;
border-bottom:1px solid #e2e8f0;overflow-wrap:anywhere}ul.findings span{min-width:0}
ul.findings b{flex:0 0 4.6rem;height:1.5rem;text-align:center;border-radius:4px;font-size:.8rem;line-height:1.5rem;
font-weight:600}.note{background:#ebf8ff;color:#2c5282}
table.facts td{text-align:left;vertical-align:top;overflow-wrap:anywhere}
table.facts td:first-child{color:#4a5568;white-space:nowrap}.side{max-width:460px}
details{margin:.4rem 0}summary{cursor:pointer}details p{font-size:.85rem;color:#4a5568;overflow-wrap:anywhere}
"""
    + SPACE_STYLE
)


def write_page(inspection: Inspection, out: Path) -> None:
    """Write the page.  Raises OutputError when that fails."""
    write_text(out, inspection_page(inspection))


def inspection_page(inspection: Inspection) -> str:
    """Return the page."""
    facts = inspection.facts
    worst = inspection.findings[0].level if inspection.findings else "note"
    colour = "ready" if worst == "note" else worst
    verdict = inspection.verdict[0].upper() + inspection.verdict[1:]
    sections = [
        f'<p class="verdict {colour}">{html.escape(verdict)}</p>',
        _findings(inspection),
        _figures(inspection),
        space(inspection),
        _seen(inspection),
        _lists(inspection),
    ]
    name = facts.path.rstrip("/").rpartition("/")[2] or facts.path
    title = f"{name}: inspection of the dataset"
    return page(title, facts.path, sections, STYLE, SCRIPT)


def _findings(inspection: Inspection) -> str:
    items = [f"<li><b class={f.level}>{f.level}</b><span>{html.escape(f.text)}</span>" for f in inspection.findings]
    return f"<ul class=findings>{''.join(items)}</ul>" if items else ""


def _figures(inspection: Inspection) -> str:
    rows = [f"<tr><td>{html.escape(k)}<td>{html.escape(v)}" for k, v in figures(inspection.facts).items()]
    return f"<h2>The dataset</h2><table class=facts>{''.join(rows)}</table>"


def _seen(inspection: Inspection) -> str:
    """A histogram, and the views that see least."""
    seen = inspection.facts.seen
    if not seen:
        return ""
    least = sorted(seen, key=lambda name: seen[name])[:8]
    rows = "".join(f"<tr><td>{html.escape(name)}<td>{seen[name]:,}" for name in least)
    return (
        "<h2>Points per view</h2><p class=sub>how many of the sparse points each photograph sees</p>"
        f"<div class=curves>{histogram('views by their number of points', list(seen.values()))}"
        f"<table class=side><tr><th>views that see least<th>points{rows}</table></div>"
    )


def _lists(inspection: Inspection) -> str:
    """The names behind the figures."""
    facts, photos = inspection.facts, inspection.facts.photos
    lists = {
        "registered but missing on disk": facts.missing,
        "on disk but without a pose": facts.unregistered,
        "cannot be read": list(photos.unreadable.values()),
        "not of the camera's size": [f"{name}: {size}" for name, size in photos.misfits.items()],
        "cut off": photos.cut,
        "to be turned, says the EXIF data": photos.exif_turned,
        "far away from all others": facts.strayed,
        "same pose": [" = ".join(names) for names in facts.same_pose],
        "few points": facts.few_seen,
    }
    parts = []
    for title, names in lists.items():
        if names:
            more = f"<br>… and {len(names) - LISTED} more" if len(names) > LISTED else ""
            text = "<br>".join(map(html.escape, names[:LISTED]))
            parts.append(f"<details><summary>{html.escape(title)} ({len(names)})</summary><p>{text}{more}</details>")
    return f"<h2>Names</h2>{''.join(parts)}" if parts else ""
