"""Find what limits a model's quality, from the views, records and cameras of its run, and suggest commands."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import pluralize, shell_quote
from clsplat.core.files import PIPELINE
from clsplat.metrics.views import Gains, ViewMetrics, measure
from clsplat.scene.view import View, sample_views
from clsplat.scene.viewpoint import nearest_to_axes, perpendicular, up_direction
from clsplat.stages.export import sky_gaussians
from clsplat.training.modules.base import color_model, learned_scene, module_class
from clsplat.training.modules.sky_choice import sky_reason
from clsplat.training.run import Run

MAX_LINES = 5
MAX_RENDERED_VIEWS = 24  # training views, evenly spaced
MAX_NAMES = 3  # of photos in a sentence
OUTLIER_DB = 5.0  # dB below the median PSNR of the views
MIN_EXPOSURE_GAIN = 1.0  # dB, by a gain per channel and photo
LOW_PSNR = 24.0  # dB, mean of the training views
TRANSIENTS_START = 1 / 3  # of the training
FEW_PHOTOS = 24  # for training
AIMED_COSINE = 0.8  # mean cosine of view directions to the center, above which the cameras look at one point
MIN_OFFSET = 0.3  # median horizontal distance / distance to the center, above which the cameras surround the center
MIN_GAP = 40.0  # degrees around the center without a photo
OPEN_SIDE_DEGREES = 120.0  # degrees; a wider gap is a side that was left out on purpose
MIN_GAP_RATIO = 3.0  # of the widest gap to the median gap


def collect_advice(run: Run, is_overfit: bool) -> list[str]:
    """Return at most MAX_LINES sentences of advice, the most important first, each with a command.

    The list is empty if nothing stands out.  Renders at most MAX_RENDERED_VIEWS training views.
    """
    views = learned_scene(run).downscaled(run.downscale).split("train")
    sample = sample_views(views, MAX_RENDERED_VIEWS)
    counted_views = run.status.counted(run.until_interrupted(sample), "views", len(sample))
    metrics = measure(run.painter(), sample, run.photographs, colors=Gains(), progress=counted_views)
    lines = [line for line in run.records.read("view") if line["downscale"] == run.downscale]
    test_psnr = {
        line["view"]: line["psnr"] for line in lines if line["split"] == "test" and line["step"] == run.model_step
    }
    rerun, resume = f"clsplat run {shell_quote(run.out / PIPELINE)}", f"clsplat resume {shell_quote(run.out)}"
    can_mask = run.learned_field is None and not any(module_class(name).masks_objects for name in run.modules)
    has_exposures = color_model(run) is not None or run.learned_field is not None
    train_longer = f"{resume} --steps {2 * run.step}"
    sentences = [
        *advise_on_training_views(metrics, has_exposures, rerun, run.step if can_mask else None),
        *advise_on_fit(metrics, is_overfit, rerun, train_longer),
        *advise_on_test_views(test_psnr, rerun),
        *advise_on_capture(views, run.original.views, rerun),
    ]
    if (reason := sky_reason(run)) and any("export" in entry for entry in run.pipeline["stages"]):
        choice, effect = ("sidecar", "leaves it out") if sky_gaussians(run) else ("splats", "adds it")
        state = "has it as distant Gaussians" if sky_gaussians(run) else "does not show it in other viewers"
        text = f"a sky was added, since {reason}; the model file {state}: `{resume} --set export.sky={choice}` {effect}"
        sentences.append(text)
    return sentences[:MAX_LINES]


def advise_on_training_views(
    metrics: Sequence[ViewMetrics], has_exposures: bool, rerun: str, steps: int | None
) -> Iterator[str]:
    """Yield advice from the metrics of training views.

    has_exposures: whether training learns exposures.  rerun: the command that repeats the run.  steps: the number of
    training steps, or None if training cannot mask moving objects.
    """
    if names := find_outliers({view.view: view.psnr for view in metrics}):
        text = f"{_join_names(names)} {'disagrees' if len(names) == 1 else 'disagree'} with the other photos"
        if steps is None:
            yield f"{text}: remove blurred photos and photos with wrong poses, then `{rerun}`"
        else:
            transients = shell_quote(f"optimize.modules.transients={{start: {round(TRANSIENTS_START * steps)}}}")
            yield f"{text}: remove blurred photos; if objects move, `{rerun} --set {transients}`"
    gains = [view.colors["psnr_color"] - view.psnr for view in metrics if "psnr_color" in view.colors]
    gain = float(np.mean(gains)) if gains else 0.0
    if not has_exposures and gain >= MIN_EXPOSURE_GAIN:
        yield (
            f"exposures or colors differ between photos: matching them would gain {gain:.1f} dB; "
            f"try `{rerun} --set optimize.modules.exposure={{}}`"
        )


def advise_on_fit(metrics: Sequence[ViewMetrics], is_overfit: bool, rerun: str, train_longer: str) -> Iterator[str]:
    """Yield advice if the model overfits, or else if it fits the photos poorly.

    rerun: the command that repeats the run.  train_longer: the command that trains longer.
    """
    train_psnr = float(np.mean([view.psnr for view in metrics])) if metrics else np.inf
    if is_overfit:
        yield f"the model overfits: add photos between the existing ones, then `{rerun}`"
    elif train_psnr < LOW_PSNR:
        yield f"the model underfits: only {train_psnr:.1f} dB on training views; train longer: `{train_longer}`"


def advise_on_test_views(psnr: Mapping[str, float], rerun: str) -> Iterator[str]:
    """Yield advice from the PSNR of test views.  psnr: dB, by the name of the view."""
    if names := find_outliers(psnr):
        yield (
            f"{_join_names(names)}: much worse than the other test views; add photos of what they show, then `{rerun}`"
        )


def advise_on_capture(train: Sequence[View], views: Sequence[View], rerun: str) -> Iterator[str]:
    """Yield advice from the number of training views and the positions of all views."""
    view_count = len({view.name for view in train})
    if view_count < FEW_PHOTOS:
        count = pluralize(view_count, "training photo")
        yield f"only {count}; show every part of the scene in at least five, from several sides, then `{rerun}`"
    if gap := find_widest_gap(views):
        degrees, first, second = gap
        arc = f"{degrees:.0f}° between {first} and {second}"
        yield f"no photo was taken in the {arc}; take photos there, then `{rerun}`"


def find_outliers(psnr: Mapping[str, float]) -> list[str]:
    """Return the names of views with a PSNR far below the median, the worst first.  psnr: dB, by name."""
    median = float(np.median(list(psnr.values()))) if psnr else 0.0
    return [name for name in sorted(psnr, key=psnr.__getitem__) if psnr[name] < median - OUTLIER_DB]


def find_widest_gap(views: Sequence[View]) -> tuple[float, str, str] | None:
    """Return the widest gap between views around the point that they look at, in degrees, and the two views next to it.

    Returns None if the views do not surround a point, if no gap stands out, or if the widest gap is an open side.
    """
    if len(views) < 3:
        return None
    centers = np.stack([view.position for view in views])
    axes = np.stack([view.world_to_camera[2, :3] for view in views])
    offsets = centers - nearest_to_axes(centers, axes, centers.mean(axis=0))
    distances = np.linalg.norm(offsets, axis=1)
    angles, radii = _cylindrical(offsets, up_direction(views))
    cosines = -(axes * offsets).sum(axis=1) / np.maximum(distances, 1e-12)
    if cosines.mean() < AIMED_COSINE or np.median(radii / np.maximum(distances, 1e-12)) < MIN_OFFSET:
        return None
    order = np.argsort(angles, kind="stable")
    gaps = np.degrees(np.diff(np.append(angles[order], angles[order[0]] + 2 * np.pi)))
    inner_gaps = np.where(gaps < OPEN_SIDE_DEGREES, gaps, 0.0)
    index = int(np.argmax(inner_gaps))
    if inner_gaps[index] < max(MIN_GAP, MIN_GAP_RATIO * float(np.median(gaps))):
        return None
    return float(gaps[index]), views[order[index]].name, views[order[(index + 1) % len(views)]].name


def _cylindrical(
    offsets: NDArray[np.floating], up: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the angles of offsets, [V, 3], around the upward axis, [V] radians, and their distances from it, [V]."""
    forward = perpendicular(up)
    x, y = offsets @ forward, offsets @ np.cross(up, forward)
    return np.arctan2(y, x), np.hypot(x, y)


def _join_names(names: Sequence[str]) -> str:
    more = len(names) - MAX_NAMES
    return ", ".join(names[:MAX_NAMES]) + (f" and {more} more" if more > 0 else "")
