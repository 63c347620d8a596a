"""Runs side by side, as one page that opens offline: metrics, curves, crops, differing settings."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from clsplat.compare import tables
from clsplat.compare.comparison import Comparison, Row, Variant
from clsplat.compare.crops import Crop, find_crops
from clsplat.compare.curves import curves
from clsplat.compare.published import PublishedTable
from clsplat.compare.run_folder import RunFolder
from clsplat.compare.seams import Seams, find_seams
from clsplat.errors import ConfigError, DataError, amount
from clsplat.files import write_text
from clsplat.pages.page import embedded, render
from clsplat.pipeline.file import SceneSettings

LOG = logging.getLogger("clsplat")
MAX_NAMES = 4  # of pipelines, in the title


@dataclass(frozen=True)
class CropFigure:
    """A crop with its images as data URLs."""

    view: str
    overview: str
    frame: dict[str, float]  # percent of the overview
    photograph: str
    renders: list[str]  # by variant
    psnrs: list[float]  # dB, by variant


@dataclass(frozen=True)
class SeamFigure:
    """The bands along the borders of blocks, as text and a data URL."""

    text: str
    rows: list[tuple[Variant, str, str]]  # PSNR of the band, and of the rest
    picture: str


@dataclass(frozen=True)
class SceneSection:
    """The section of the page about one scene."""

    name: str
    variants: list[Variant]
    several_seeds: bool
    explanations: list[str]  # of the tables
    remarks: list[str]
    main: tables.Table
    other: tables.Table | None
    curves: list[Markup]
    crops: list[CropFigure]
    no_crops: str  # the reason
    seams: SeamFigure | None = None


def write_comparison(
    paths: Sequence[Path],
    out: Path,
    title: str = "",
    remarks: Sequence[str] = (),
    published: Sequence[PublishedTable] = (),
) -> int:
    """Write the page on some run folders; return the number of runs on it.  Raises what Comparison.read raises."""
    comparison = Comparison.read(paths)
    faults = [fault for run in comparison.runs for fault in run.missing_plugins]
    for fault in faults:
        LOG.warning("%s", fault)
    remarks = [*remarks, *faults]
    write_text(out, comparison_page(comparison, title, remarks, out.parent, published))
    return len(comparison.runs)


def comparison_page(
    comparison: Comparison,
    title: str,
    remarks: Sequence[str],
    folder: Path,
    published: Sequence[PublishedTable] = (),
) -> str:
    """Return the page for a folder; the default title is the names of the pipelines; `remarks` are at the top."""
    runs, scenes, variants = comparison.runs, comparison.scenes, comparison.variants
    names = list(dict.fromkeys(run.metrics.pipeline for run in runs))
    title = title or " · ".join([*names[:MAX_NAMES], *(["…"] if len(names) > MAX_NAMES else [])])
    devices = {run.metrics.device for run in runs}
    device = f"device: {devices.pop()}" if len(devices) == 1 else "several devices"
    return render(
        "compare.html.j2",
        title=f"{title}: {amount(len(runs), 'run')}",
        subtitle=f"{amount(len(variants), 'variant')} on {amount(len(scenes), 'scene')}; {device}",
        remarks=remarks,
        means=tables.means_over_scenes(comparison) if len(scenes) > 1 else None,
        scenes=[_section(name, rows) for name, rows in scenes.items()],
        variants=variants,
        published=published,
        settings=tables.differing_settings(variants),
        runs=[(comparison.variant(run), str(run.path), run.metrics.seed, _links(run, folder)) for run in runs],
    )


def _links(run: RunFolder, folder: Path) -> dict[str, str]:
    """The pages of a run, with their addresses from a folder."""
    files = {stage: run.path / run.metrics.files.get(stage, "") for stage in ("report", "viewer")}
    return {
        stage: quote(Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix())
        for stage, file in files.items()
        if file.is_file()
    }


def _section(name: str, rows: Sequence[Row]) -> SceneSection:
    crops, no_crops, seams = _pictures(rows)
    several_seeds = any(len(row.runs) > 1 for row in rows)
    explanations = ["mean ± standard deviation over seeds"] if several_seeds else []
    return SceneSection(
        name=name,
        variants=[row.variant for row in rows],
        several_seeds=several_seeds,
        explanations=[*_sizes(rows[0].runs[0].scene), *explanations, *(["bold: the best"] if len(rows) > 1 else [])],
        remarks=list(tables.differing_conditions(rows)),
        main=tables.main_table(rows),
        other=tables.other_table(rows),
        curves=curves(rows),
        crops=[_figure(crop) for crop in crops],
        no_crops=no_crops,
        seams=_seam_figure(seams, rows) if seams else None,
    )


def _sizes(scene: SceneSettings) -> list[str]:
    """What sizes mean, where the training did not see the photographs as they are, or saw several."""
    first, *more = (f"1/{downscale:g}" if downscale != 1 else "full size" for downscale in scene.downscales)
    if first == "full size" and not more:
        return []
    return [f"sizes are shares of the photographs' own; trained at {', '.join([first, *more])}"]


def _pictures(rows: Sequence[Row]) -> tuple[list[Crop], str, Seams | None]:
    """Crops of each row's first run, or why there are none, such as missing photographs; and seams of blocks."""
    runs = [row.runs[0] for row in rows]
    settings = runs[0].scene
    try:
        photographs, background = settings.read(runs[0].photographs)
        scene = photographs.downscaled(settings.downscale)
    except (DataError, ConfigError) as error:
        LOG.warning("no crops: %s", error)
        return [], str(error), None
    crops = find_crops(runs, scene, background)
    reason = "" if crops else "there is no view that all runs rendered; add `- render` to the stages"
    return crops, reason, find_seams(runs, scene, background)


def _seam_figure(seams: Seams, rows: Sequence[Row]) -> SeamFigure:
    text = (
        f"{100 * seams.share:.1f} % of the pixels of {amount(seams.views, 'view')} show what lies near a border of "
        f"blocks; red in {seams.view}"
    )
    figures = zip(rows, seams.band, seams.rest, strict=True)
    found = [(row.variant, f"{band:.2f}", f"{rest:.2f}") for row, band, rest in figures]
    return SeamFigure(text, found, embedded(seams.picture))


def _figure(crop: Crop) -> CropFigure:
    """The crop for the page; PNG keeps every bit of its squares."""
    return CropFigure(
        view=crop.view,
        overview=embedded(crop.overview),
        frame=crop.frame,
        photograph=embedded(crop.photograph, ".png"),
        renders=[embedded(image, ".png") for image in crop.renders],
        psnrs=crop.psnrs,
    )
