"""Draws of Gaussians without replacement."""

import numpy as np
from numpy.typing import NDArray

from clsplat.density.detail import largest
from clsplat.density.edit import Edit
from clsplat.formats.splats import inverse_opacities


def sampled(
    candidates: NDArray[np.bool_], weights: NDArray[np.float64], number: int, random: np.random.Generator
) -> NDArray[np.bool_]:
    """Draw so many of the candidates, [N], one after another by their weights, 0 to infinity (Efraimidis and Spirakis
    2006: those with the largest ln(U) / weight)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        keys = np.log1p(-random.random(len(weights))) / weights
    return largest(candidates, keys, number)


def faint_or_large(edit: Edit, opacity_below: float, size_above: float) -> NDArray[np.bool_]:
    """Return which Gaussians, [N], are fainter or larger, among those that the rules so far leave.

    size_above: largest standard deviation, of the children after a split, as a share of the extent.
    """
    gaussians = edit.gaussians
    opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
    size = np.exp(gaussians.get("log_scales").max(axis=1)) * edit.shrink.get()
    found: NDArray[np.bool_] = (opacity < opacity_below) | (size > size_above * edit.scene_scale.extent)
    return found & (edit.rows() > 0)
