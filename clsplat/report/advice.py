"""What would make a scene better, in sentences for the page of a run."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import amount
from clsplat.metrics.views import ViewMetrics, measure
from clsplat.render.backdrops import Auto, Backdrop
from clsplat.scene.stand import across, closest_point, upward
from clsplat.scene.view import View, some_of
from clsplat.training.colours import colours_of
from clsplat.training.poses import refined
from clsplat.training.run import Run
from clsplat.views.colours import Gain

MOST = 24  # training views that are measured, evenly spaced
NAMED = 3  # photographs in a sentence
APART = 5.0  # dB below the median of the views
GAINED = 1.0  # dB by three numbers for the colours of each photograph
FEW = 24  # training photographs
AIMED = 0.8  # mean cosine between a camera's axis and the direction of the middle: cameras that look at one place
AROUND = 0.3  # of the distance to the middle, across the upward axis: cameras that stand around it
GAP = 40.0  # degrees around the middle without a photograph
OPEN = 120.0  # degrees; a gap from here on is the side from which nobody meant to look
UNEVEN = 3.0  # times the median gap


def advice(run: Run) -> list[str]:
    """Return sentences, or none where nothing stands out.  Renders at most MOST training views."""
    views = refined(run.numbers, run.original).downscaled(run.downscale).split("train")
    chosen = some_of(views, MOST)
    counted = run.status.counted(run.until_interrupted(chosen), "views", len(chosen))
    found = measure(run.painter(), chosen, run.photographs, colours=Gain(), counted=counted)
    lines = [line for line in run.records.read("view") if line["downscale"] == run.downscale]
    test = {line["view"]: line["psnr"] for line in lines if line["split"] == "test" and line["step"] == run.model_step}
    return [
        *of_training_views(found, has_colours=colours_of(run) is not None),
        *of_test_views(test),
        *of_capture(views, run.original.views),
        *of_sky(run.model_settings.background),
    ]


def of_training_views(found: Sequence[ViewMetrics], has_colours: bool) -> Iterator[str]:
    """What the figures of training views tell.  has_colours: whether photographs have colours of their own."""
    if names := far_below({one.view: one.psnr for one in found}):
        yield (
            f"{_listed(names)} {'disagrees' if len(names) == 1 else 'disagree'} with the others: look for blur, "
            "a wrong camera, or what has moved, and leave such photographs out, or mask what has moved"
        )
    gains = [one.colours["psnr_colour"] - one.psnr for one in found if "psnr_colour" in one.colours]
    gained = float(np.mean(gains)) if gains else 0.0
    if not has_colours and gained >= GAINED:
        yield (
            f"exposures or colours differ: in their own colours photographs would be {gained:.1f} dB nearer; "
            "try `--set optimize.colours=gain`"
        )


def of_test_views(psnr: Mapping[str, float]) -> Iterator[str]:
    """What the PSNR of test views, dB by name, tells."""
    if names := far_below(psnr):
        yield f"{_listed(names)}: much worse than the other test views; take more photographs of what is seen there"


def of_capture(train: Sequence[View], views: Sequence[View]) -> Iterator[str]:
    """What the training views, and where all views stand, tell."""
    number = len({view.name for view in train})
    if number < FEW:
        yield f"{amount(number, 'training photograph')}: few; show every place in five, from several sides"
    if gap := widest_gap(views):
        degrees, one, other = gap
        yield f"no photograph is from the {degrees:.0f}° between {one} and {other}; take some there"


def of_sky(background: Backdrop | None) -> Iterator[str]:
    """What a sky means that was chosen by the photographs."""
    if isinstance(background, Auto) and background.in_use is not None:
        why, _, _ = background.reason.partition(";")
        yield f"a sky was added, since {why}; other viewers show it where `export` has `sky: splats`"


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
    centres = np.stack([view.position for view in views])
    axes = np.stack([view.world_to_camera[2, :3] for view in views])
    from_middle = centres - closest_point(centres, axes, centres.mean(axis=0))
    distances = np.linalg.norm(from_middle, axis=1)
    angles, aside = _around(from_middle, upward(views))
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
    ahead = across(up)
    x, y = offsets @ ahead, offsets @ np.cross(up, ahead)
    return np.arctan2(y, x), np.hypot(x, y)


def _listed(names: Sequence[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
