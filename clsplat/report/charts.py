"""Curves over the steps of a run, and of its Gaussians."""

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from clsplat.metrics.distribution import SHARES
from clsplat.pages.page import charts
from clsplat.pages.svg import COLOURS, Line, curve
from clsplat.training.forecast import VIEWS, over_views
from clsplat.training.run import Run

NAMES = {"train": "training views", "test": "test views", "validation": "validation views"}
DOTTED = 2  # place in DASHES


def training_charts(run: Run) -> list[Markup]:
    """Draw PSNR, loss, Gaussians and times over the steps."""
    train = run.records.read("train")
    measured, trial = _measured(run), _measured(run, trial=True)
    running = DOTTED if any(line.name == NAMES["train"] for line in measured) else 0
    psnr = list(zip([r["step"] for r in train], over_views([r["psnr"] for r in train]), strict=True))
    line = {key: [(r["step"], r[key]) for r in train if key in r] for key in ("loss", "gaussians", "ms")}
    seen = Line(psnr, f"training views, mean of the last {VIEWS}", COLOURS[0], running)
    return charts(
        [
            curve("PSNR, dB", [seen, *measured]),
            *([curve("PSNR before the refit, dB", trial)] if trial else []),
            curve("loss", [Line(line["loss"])], logarithmic=True),
            curve("Gaussians", [Line(line["gaussians"])]),
            curve("milliseconds per step", [Line(line["ms"])]),
        ]
        if train
        else []
    )


def _measured(run: Run, trial: bool = False) -> list[Line]:
    """PSNR of each split over the steps whose model was measured, by the last measurement of each; `trial`: before a
    refit."""
    points: dict[str, dict[int, float]] = {split: {} for split in NAMES}
    for line in run.records.read("evaluate", trial):
        if line["downscale"] == run.downscale:
            points[line["split"]][line["step"]] = line["psnr"]
    colours = dict(zip(NAMES, COLOURS, strict=False))
    return [Line(sorted(one.items()), NAMES[split], colours[split]) for split, one in points.items() if one]


def gaussians_charts(run: Run) -> list[Markup]:
    """Distributions of size, shape and opacity during training, effects of the density rules, PSNR by Gaussians."""
    lines = run.records.read("distribution")
    if len(lines) < 2:
        return []
    shares = [f"{share:.0%}" for share in SHARES]

    def quantiles(name: str) -> list[Line]:
        return [Line([(r["step"], r[name][i]) for r in lines], share) for i, share in enumerate(shares)]

    return charts(
        [
            curve("size (rms scale, scene units), quantiles", quantiles("size"), logarithmic=True),
            curve("anisotropy (longest by shortest axis), quantiles", quantiles("anisotropy"), logarithmic=True),
            curve("opacity, quantiles", quantiles("opacity")),
            curve("Gaussians changed by each rule, in all", _totals(run, "causes")),
            curve("share of growth so far, by rule", _shares(_totals(run, "grown"))),
            curve("test PSNR, dB, over thousands of Gaussians", _psnr_by_gaussians(run)),
        ]
    )


def _totals(run: Run, what: str) -> list[Line]:
    """Gaussians that each rule of density control has changed so far, or added."""
    edits = run.records.read("densify")
    names = dict.fromkeys(name for edit in edits for name in edit.get(what, {}))
    totals = {name: np.cumsum([edit.get(what, {}).get(name, 0) for edit in edits]) for name in names}
    steps = [edit["step"] for edit in edits]
    return [Line(list(zip(steps, map(float, total), strict=True)), name) for name, total in totals.items()]


def _shares(lines: Sequence[Line]) -> list[Line]:
    """The lines divided by their sum, where it is not zero; lines that are always zero are left out."""
    sums = np.sum([[y for _, y in line.points] for line in lines], axis=0) if lines else []
    shares = [[(x, y / total) for (x, y), total in zip(line.points, sums, strict=True) if total > 0] for line in lines]
    return [Line(points, line.name) for points, line in zip(shares, lines, strict=True) if any(y for _, y in points)]


def _psnr_by_gaussians(run: Run) -> list[Line]:
    """Points in order of steps: where Gaussians are pruned, the line turns back.  No line for a single point."""
    counts = {r["step"]: r["gaussians"] for r in run.records.read("train") if "gaussians" in r}
    tests = [r for r in run.records.read("evaluate") if r["split"] == "test" and r["downscale"] == run.downscale]
    points = {r["step"]: (counts[r["step"]] / 1e3, r["psnr"]) for r in tests if r["step"] in counts}
    return [Line(list(points.values()))] if len(points) > 1 else []
