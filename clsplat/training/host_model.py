"""The model of a run as it goes into files: its tables on the host, and how it was rendered in training."""

from typing import Any

from clsplat.gaussians.model import Model, Rendering
from clsplat.training.run import Run
from clsplat.version import __version__


def host_model(run: Run) -> Model:
    """Copy the model to the host, as it is trained: with a world filter that is not part of its scales.

    Raises ConfigError when no stage has made one.
    """
    gaussians = run.model.gaussians
    tables = {name: gaussians.get(name) for name in (*gaussians.trained, "filter_variance")}
    if not tables["filter_variance"].any():
        del tables["filter_variance"]
    rendering = Rendering.of({"version": __version__, **_rendering(run)}, "default")
    return Model(**tables, rendering=rendering, sky=run.sky.sky.host() if run.sky else None)


def _rendering(run: Run) -> dict[str, Any]:
    """The numbers for rendering a model file as in training."""
    model = run.model
    found: dict[str, Any] = {
        "near": model.near,
        "screen_variance": model.screen_variance,
        "compensate": model.compensate,
        "background": run.photographs.background_name,
        "alpha": run.original.views[0].alpha,
    }
    if model.pixel_box:
        found["pixel_box"] = model.pixel_box
    if run.sky:
        found["sky"] = "directions"
    return found
