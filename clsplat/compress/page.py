"""The rate–distortion curve of a search, and its table, as text and as a page that opens offline."""

from collections.abc import Sequence
from typing import Any

from clsplat.compress.target import Point, Target
from clsplat.pages.columns import text_table
from clsplat.pages.page import charts, render
from clsplat.pages.svg import Line, curve

HEADINGS = ("Gaussians", "share", "degree", "quality", "MB", "of the model", "PSNR, dB", "change, dB", "SSIM")


def cells(point: Point, source: Point) -> list[str]:
    """Return a row of the table."""
    return [
        f"{point.gaussians:,}",
        f"{point.keep:.0%}",
        str(point.degree),
        point.quality or "–",
        f"{point.bytes / 1e6:.3g}",
        f"{point.bytes / source.bytes:.1%}",
        f"{point.psnr:.2f}",
        f"{point.psnr - source.psnr:+z.2f}",
        f"{point.ssim:.4f}",
    ]


def table(found: dict[str, Any]) -> str:
    """Return the record of a search as lines of text; a star marks the file that was chosen."""
    source, points = Point(**found["source"]), [Point(**point) for point in found["points"]]
    chosen = found["chosen"] and Point(**found["chosen"])
    marks = ["", "", *("*" if point == chosen else "" for point in points)]
    rows = [HEADINGS, *(cells(point, source) for point in (source, *points))]
    return text_table([[mark, *row] for mark, row in zip(marks, rows, strict=True)])


def page(
    target: Target,
    source: Point,
    points: Sequence[Point],
    chosen: Point | None,
    split: str,
    scene: str,
    model: str,
    result: str = "",
) -> str:
    """Return the page on a search for a model's file; `result`: the name of the one that it wrote."""
    return render(
        "compress.html.j2",
        title=f"{scene} · {source.file}, compressed to {target.text}",
        subtitle=f"{model}; PSNR and SSIM of {split} views, of every file as it is read back",
        result=result,
        verdict=_verdict(target, source, chosen),
        curves=charts([curve("PSNR, dB, over the file's size, MB", _lines(target, source, points))]),
        headings=HEADINGS,
        rows=[(point.file, cells(point, source), point == chosen) for point in (source, *points)],
    )


def _verdict(target: Target, source: Point, chosen: Point | None) -> str:
    if chosen is None:
        return f"No file meets the target {target.text} so far."
    return (
        f"{chosen.file}: {chosen.bytes / 1e6:.3g} MB, {chosen.bytes / source.bytes:.1%} of the model, "
        f"{chosen.psnr:.2f} dB, {chosen.psnr - source.psnr:+z.2f} dB"
    )


def _lines(target: Target, source: Point, points: Sequence[Point]) -> list[Line]:
    """A line for each share of the Gaussians, and the target."""
    shares = dict.fromkeys(point.keep for point in points)
    lines = [
        Line(sorted((p.bytes / 1e6, p.psnr) for p in points if p.keep == keep), f"{keep:.0%} of the Gaussians")
        for keep in shares
    ]
    largest = max((point.bytes for point in points), default=0) / 1e6
    if target.change is not None and points:
        level = source.psnr + target.change
        lines.append(Line([(0, level), (largest, level)], f"target {target.text}", "var(--target)", dash=1))
    return lines
