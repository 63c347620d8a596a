"""The run as one page that opens offline: pictures, cameras, figures, curves, times on the device, settings."""

import logging
import os
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from urllib.parse import quote

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from clsplat.core.errors import pluralize, size_text
from clsplat.core.files import PIPELINE, write_text
from clsplat.core.page import data_url, duration_text, render, safe_charts
from clsplat.core.reading import read_text
from clsplat.metrics.perceptual import Image
from clsplat.metrics.views import SHARES, Gains, ViewMetrics, measure, render_view
from clsplat.prepare.gather import summarize_placement
from clsplat.scene.scene import SPLITS
from clsplat.scene.view import View, sample_views
from clsplat.scene.viewpoint import nearest_to_axes, perpendicular, up_direction
from clsplat.training.best_model import Measured
from clsplat.training.modules.base import color_model, learned_scene
from clsplat.training.modules.sky_choice import sky_advice
from clsplat.training.records import VIEWS, over_views
from clsplat.training.run import Run
from clsplat.training.stage import Stage, path_in_run
from clsplat.viewer.charts import COLORS, Line, camera_plans, curve

# What would make a scene better, in sentences for the page of a run.

MOST = 24  # training views that are measured, evenly spaced
NAMED = 3  # photographs in a sentence
APART = 5.0  # dB below the median of the views
GAINED = 1.0  # dB by three numbers for the colors of each photograph
FEW = 24  # training photographs
AIMED = 0.8  # mean cosine between a camera's axis and the direction of the middle: cameras that look at one place
AROUND = 0.3  # of the distance to the middle, across the upward axis: cameras that stand around it
GAP = 40.0  # degrees around the middle without a photograph
OPEN = 120.0  # degrees; a gap from here on is the side from which nobody meant to look
UNEVEN = 3.0  # times the median gap


def advice(run: Run) -> list[str]:
    """Return sentences, or none where nothing stands out.  Renders at most MOST training views."""
    views = learned_scene(run).downscaled(run.downscale).split("train")
    chosen = sample_views(views, MOST)
    counted = run.status.counted(run.until_interrupted(chosen), "views", len(chosen))
    found = measure(run.painter(), chosen, run.photographs, colors=Gains(), counted=counted)
    lines = [line for line in run.records.read("view") if line["downscale"] == run.downscale]
    test = {line["view"]: line["psnr"] for line in lines if line["split"] == "test" and line["step"] == run.model_step}
    return [
        *of_training_views(found, has_colors=color_model(run) is not None),
        *of_test_views(test),
        *of_capture(views, run.original.views),
        *sky_advice(run),
    ]


def of_training_views(found: Sequence[ViewMetrics], has_colors: bool) -> Iterator[str]:
    """What the figures of training views tell.  has_colors: whether photographs have colors of their own."""
    if names := far_below({one.view: one.psnr for one in found}):
        yield (
            f"{_listed(names)} {'disagrees' if len(names) == 1 else 'disagree'} with the others: look for blur, "
            "a wrong camera, or what has moved, and leave such photographs out, or mask what has moved"
        )
    gains = [one.colors["psnr_color"] - one.psnr for one in found if "psnr_color" in one.colors]
    gained = float(np.mean(gains)) if gains else 0.0
    if not has_colors and gained >= GAINED:
        yield (
            f"exposures or colors differ: in their own colors photographs would be {gained:.1f} dB nearer; "
            "try `--set optimize.modules.exposure={}`"
        )


def of_test_views(psnr: Mapping[str, float]) -> Iterator[str]:
    """What the PSNR of test views, dB by name, tells."""
    if names := far_below(psnr):
        yield f"{_listed(names)}: much worse than the other test views; take more photographs of what is seen there"


def of_capture(train: Sequence[View], views: Sequence[View]) -> Iterator[str]:
    """What the training views, and where all views stand, tell."""
    number = len({view.name for view in train})
    if number < FEW:
        yield f"{pluralize(number, 'training photograph')}: few; show every place in five, from several sides"
    if gap := widest_gap(views):
        degrees, one, other = gap
        yield f"no photograph is from the {degrees:.0f}° between {one} and {other}; take some there"


def far_below(psnr: Mapping[str, float]) -> list[str]:
    """Return the names of views that are far below the median, the worst first; psnr: dB, by name."""
    median = float(np.median(list(psnr.values()))) if psnr else 0.0
    return [name for name in sorted(psnr, key=psnr.__getitem__) if psnr[name] < median - APART]


def widest_gap(views: Sequence[View]) -> tuple[float, str, str] | None:
    """Return the widest gap between views that stand around what they look at, degrees, and the views on its sides.

    None where they look elsewhere, where no gap stands out, and for the side that is open.
    """
    if len(views) < 3:
        return None
    centers = np.stack([view.position for view in views])
    axes = np.stack([view.world_to_camera[2, :3] for view in views])
    from_middle = centers - nearest_to_axes(centers, axes, centers.mean(axis=0))
    distances = np.linalg.norm(from_middle, axis=1)
    angles, aside = _around(from_middle, up_direction(views))
    aimed = -(axes * from_middle).sum(axis=1) / np.maximum(distances, 1e-12)
    if aimed.mean() < AIMED or np.median(aside / np.maximum(distances, 1e-12)) < AROUND:
        return None
    order = np.argsort(angles, kind="stable")
    gaps = np.degrees(np.diff(np.append(angles[order], angles[order[0]] + 2 * np.pi)))
    inner = np.where(gaps < OPEN, gaps, 0.0)
    widest = int(np.argmax(inner))
    if inner[widest] < max(GAP, UNEVEN * float(np.median(gaps))):
        return None
    return float(gaps[widest]), views[order[widest]].name, views[order[(widest + 1) % len(views)]].name


def _around(offsets: NDArray[np.floating], up: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angles around the upward axis, radians, and distances from it, of offsets, [V, 3]."""
    ahead = perpendicular(up)
    x, y = offsets @ ahead, offsets @ np.cross(up, ahead)
    return np.arctan2(y, x), np.hypot(x, y)


def _listed(names: Sequence[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")


def cameras(run: Run) -> list[Markup]:
    """Draw the cameras by split, with Gaussians around them, from above and from the side."""
    points = run.model.gaussians.get("means") if run.gaussians else np.zeros((0, 3), np.float32)
    return safe_charts(camera_plans({split: run.original.split(split) for split in SPLITS}, points))


# Curves over the steps of a run, and of its Gaussians.

NAMES = {"train": "training views", "test": "test views", "validation": "validation views"}
DOTTED = 2  # place in DASHES


def training_charts(run: Run) -> list[Markup]:
    """Draw PSNR, loss, Gaussians and times over the steps."""
    train = run.records.read("train")
    measured, trial = _measured(run), _measured(run, trial=True)
    running = DOTTED if any(line.name == NAMES["train"] for line in measured) else 0
    psnr = list(zip([r["step"] for r in train], over_views([r["psnr"] for r in train]), strict=True))
    line = {key: [(r["step"], r[key]) for r in train if key in r] for key in ("loss", "gaussians", "ms")}
    seen = Line(psnr, f"training views, mean of the last {VIEWS}", COLORS[0], running)
    return safe_charts(
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
    colors = dict(zip(NAMES, COLORS, strict=False))
    return [Line(sorted(one.items()), NAMES[split], colors[split]) for split, one in points.items() if one]


def gaussians_charts(run: Run) -> list[Markup]:
    """Distributions of size, shape and opacity during training, effects of the density rules, PSNR by Gaussians."""
    lines = run.records.read("distribution")
    if len(lines) < 2:
        return []
    shares = [f"{share:.0%}" for share in SHARES]

    def quantiles(name: str) -> list[Line]:
        return [Line([(r["step"], r[name][i]) for r in lines], share) for i, share in enumerate(shares)]

    return safe_charts(
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


# Whether a model has learned its photographs by heart, in words.

REMEDY = (
    "More photographs, from places between these, help most; `scene.validation: auto` with `optimize.keep: best`, in a "
    "pipeline without `take_average` such as splat_7k, keeps the model that is best elsewhere."
)


def overfitting_note(run: Run) -> str:
    """Return how good the model is where it was trained and elsewhere; "" where that is not known, or unremarkable."""
    if run.best:
        return run.best.text()
    split, now = _psnr_elsewhere(run)
    if now is None:
        return ""
    text = now.text(split)
    return f"{text} {REMEDY}" if now.is_overfit else text if split == "validation" else ""


def is_overfit(run: Run) -> bool:
    """Return whether the model of a run has learned its photographs by heart, as far as that is known."""
    now = run.best.measured if run.best else _psnr_elsewhere(run)[1]
    return now is not None and now.is_overfit


def _psnr_elsewhere(run: Run) -> tuple[str, Measured | None]:
    """The split whose views were not trained on, and the last PSNR there and at training views.

    Validation views come before test views; training views that were not measured count as the reports saw them.
    """
    lines = [line for line in run.records.read("evaluate") if line["downscale"] == run.downscale]
    for split in ("validation", "test"):
        measured = [line for line in lines if line["split"] == split]
        train = _training(run, lines, measured[-1]["step"]) if measured else None
        if train is not None:
            return split, Measured(step=measured[-1]["step"], train=train, validation=measured[-1]["psnr"])
    return "", None


def _training(run: Run, lines: list[dict[str, Any]], step: int) -> float | None:
    """The PSNR at training views, dB, measured at a step, or else over the reports up to it."""
    measured = [line["psnr"] for line in lines if line["split"] == "train" and line["step"] == step]
    reports = [line["psnr"] for line in run.records.read("train") if line["step"] <= step]
    return measured[-1] if measured else over_views(reports)[-1] if reports else None


# Where the time of a training step goes on the device.


@dataclass(frozen=True)
class StageTime:
    """The mean time of one stage of a training step."""

    name: str
    milliseconds: float
    percent: float


@dataclass(frozen=True)
class Times:
    """The time of a step's stages on the device, averaged over the sampled steps."""

    samples: int
    milliseconds: float  # of all stages
    stages: list[StageTime]


def times(run: Run) -> Times | None:
    """Return the times; None where no step was sampled."""
    samples = [r["stages"] for r in run.records.read("train") if r.get("stages")]
    totals: dict[str, float] = defaultdict(float)
    for sample in samples:
        for name, milliseconds in sample.items():
            totals[name] += milliseconds / len(samples)
    whole = sum(totals.values())
    if whole == 0:
        return None
    return Times(len(samples), whole, [StageTime(name, ms, 100 * ms / whole) for name, ms in totals.items()])


# Views beside their photographs: the worst and the best.

MAX_VIEWS = 3  # of the worst, and of the best


@dataclass(frozen=True)
class ViewFigure:
    """Images of one view with a caption."""

    caption: str
    images: dict[str, str]  # label -> data URL


def views(run: Run) -> dict[str, list[ViewFigure]]:
    """Return the best and the worst views of the last evaluation, by heading."""
    by_name = {view.name: view for view in run.scene.downscaled(run.downscale).views}
    lines = [r for r in run.records.read("view") if r["downscale"] == run.downscale and r["step"] == run.model_step]
    last = {r["view"]: r for r in lines if r["view"] in by_name}  # a view may be measured twice after the same step
    ranked = sorted(last.values(), key=lambda r: r["psnr"])
    worst = ranked[:MAX_VIEWS]
    best = [r for r in reversed(ranked) if r not in worst][:MAX_VIEWS]
    chosen = {"The best views": best, "The worst views": worst}

    def figure(record: dict[str, Any]) -> ViewFigure:
        photograph = run.photographs.get(by_name[record["view"]])
        image = render_view(run.painter(), photograph.camera)
        return _figure(record, image, photograph.image())

    return {
        title: [figure(record) for record in run.until_interrupted(records)]
        for title, records in chosen.items()
        if records
    }


def _figure(record: dict[str, Any], image: Image, photograph: Image) -> ViewFigure:
    difference = np.clip(np.abs(image.astype(np.int16) - photograph) * 4, 0, 255).astype(np.uint8)
    images = {"render": image, "photograph": photograph, "difference": difference}
    caption = f"{record['view']} ({record['split']}): {record['psnr']:.2f} dB, SSIM {record['ssim']:.4f}"
    return ViewFigure(caption, {label: data_url(pixels) for label, pixels in images.items()})


LOG = logging.getLogger("clsplat")
MORE = {  # of clsplat/metrics/views.py: name and unit
    "psnr_color": ("PSNR in the photographs' colors", "dB"),
    "psnr_affine": ("PSNR with colors fitted", "dB"),
    "psnr_held_out_moments": ("PSNR at held-out moments", "dB"),
    "psnr_other_moments": ("PSNR at other moments", "dB"),
    "psnr_static": ("PSNR of static pixels", "dB"),
    "flicker": ("flicker of static pixels", "levels"),
    "flicker_photographs": ("flicker of the photographs there", "levels"),
}


class HtmlReport(Stage):
    """Write report.html."""

    stage: Literal["report"] = "report"
    needs: ClassVar[frozenset[str]] = frozenset({"painter", "metrics"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(".html")] = "report.html"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        advised = advice(run)
        page = render(
            "report.html.j2",
            title=run.scene_name,
            subtitle=f"{run.name} · {run.device.text}",
            main=_main(run),
            overfitting_note=overfitting_note(run),
            advice=advised,
            photographs=summarize_placement(run.preparation) or f"{pluralize(len(run.original.views), 'photograph')}",
            viewers=_addresses(run, "viewer", run.out / self.file),
            models=_addresses(run, "export", run.out / self.file),
            views=views(run),
            cameras=cameras(run),
            figures=_figures(run),
            training=training_charts(run),
            gaussians=gaussians_charts(run),
            times=times(run),
            settings=_settings(run),
        )
        write_text(run.out / self.file, page)
        LOG.debug("report written to %s", run.out / self.file)  # the summary of the run names its files
        for text in advised:
            LOG.info("advice: %s", text)


def _addresses(run: Run, stage: str, page: Path) -> dict[str, str]:
    """The files that stages of this name write, by their paths in the run, with their addresses beside the page."""
    files = [Path(one[stage]["file"]) for one in run.pipeline["stages"] if stage in one]
    return {file.as_posix(): quote(Path(os.path.relpath(run.out / file, page.parent)).as_posix()) for file in files}


def _main(run: Run) -> str:
    """The figures that are looked for first."""
    test = run.metrics.get("test", {}).get(f"{run.downscale:g}")
    quality = [f"test PSNR {test['psnr']:.2f} dB, SSIM {test['ssim']:.4f}"] if test else []
    quality += [f"the model of step {run.model_step:,}"] if run.model_step != run.step else []
    others = _size(run), f"trained for {duration_text(run.train_seconds)}"
    return " · ".join([*quality, *others])


def _size(run: Run) -> str:
    return size_text(run.gaussians, run.learned_field.parameters if run.learned_field else None)


def _figures(run: Run) -> dict[str, str]:
    values = {}
    for split, by_downscale in sorted(run.metrics.items(), key=lambda item: SPLITS.index(item[0])):
        for downscale, averages in by_downscale.items():
            suffix = "" if downscale == f"{run.downscale:g}" else f" at 1/{downscale}"
            values[f"{split} PSNR{suffix} ({pluralize(averages['views'], 'view')})"] = f"{averages['psnr']:.2f} dB"
            for key, (name, unit) in MORE.items():
                if averages.get(key) is not None:
                    some = f" ({pluralize(averages[f'{key}_views'], 'view')})" if f"{key}_views" in averages else ""
                    values[f"{split} {name}{suffix}{some}"] = f"{averages[key]:.2f} {unit}"
            values[f"{split} SSIM{suffix}"] = f"{averages['ssim']:.4f}"
    if run.is_refit and run.best:
        found = run.best.measured
        values["validation PSNR before the refit"] = f"{found.validation:.2f} dB"
        values["training PSNR before the refit"] = f"{found.train:.2f} dB"
    number, _, what = _size(run).partition(" ")
    values[what] = number
    values["steps"] = f"{run.step:,}"
    values["training"] = duration_text(run.train_seconds)
    return values


def _settings(run: Run) -> str:
    path = run.out / PIPELINE
    return read_text(path) if path.exists() else ""
