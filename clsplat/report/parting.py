"""Whether a model has learnt its photographs by heart, in words."""

from typing import Any

from clsplat.training.forecast import over_views
from clsplat.training.kept import Measured
from clsplat.training.run import Run

REMEDY = (
    "More photographs, from places between these, help most; `scene.validation: auto` with `optimize.keep: best`, in a "
    "pipeline without `take_average` such as splat_7k, keeps the model that is best elsewhere."
)


def parting(run: Run) -> str:
    """Return how good the model is where it was trained and elsewhere; "" where that is not known, or unremarkable."""
    if run.best:
        return run.best.told()
    split, now = _measured(run)
    if now is None:
        return ""
    text = now.told(split)
    return f"{text} {REMEDY}" if now.is_apart else text if split == "validation" else ""


def is_by_heart(run: Run) -> bool:
    """Return whether the model of a run has learnt its photographs by heart, as far as that is known."""
    now = run.best.found if run.best else _measured(run)[1]
    return now is not None and now.is_apart


def _measured(run: Run) -> tuple[str, Measured | None]:
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
