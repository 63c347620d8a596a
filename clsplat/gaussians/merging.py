"""Several models as one."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from clsplat.errors import DataError
from clsplat.formats.splats import with_degree
from clsplat.gaussians.model import Model
from clsplat.gaussians.motion import alike

LOG = logging.getLogger("clsplat")
KEPT = ("near", "screen_variance", "background", "alpha")  # of the first model


def merged(models: Sequence[Model], names: Sequence[str]) -> Model:
    """Return one model of all Gaussians, with the numbers of the first for rendering and the largest SH degree.

    Where one has a world filter and another has none, it is baked; where some move, the others stand still.  Raises
    DataError where some are mip models and others are not, or of the pixel's box, for one filter serves all, and where
    they move in different ways.
    """
    first = models[0]
    if len(models) == 1:
        return first
    for model, name in zip(models, names, strict=True):
        kinds = [_kind(m) for m in (first, model)]
        if kinds[0] != kinds[1]:
            raise DataError(f"{name}: is {kinds[1]}, {names[0]} is {kinds[0]}; expected the same: one filter draws all")
        own, kept = model.rendering.comment(), first.rendering.comment()
        if other := [f"{one} = {own.get(one, 'not given')}" for one in KEPT if own.get(one) != kept.get(one)]:
            LOG.warning("%s: has %s; what %s says is kept", name, ", ".join(other), names[0])
    if any(model.filter_variance is None for model in models):
        models = [model.baked() for model in models]
    degree = max(model.sh_degree for model in models)
    tables = alike([with_degree(model.tables(), degree) for model in models], names)
    merged: dict[str, Any] = {n: np.concatenate([t[n] for t in tables]) for n in tables[0]}
    return Model(**merged, rendering=first.rendering, sky=first.sky)


def _kind(model: Model) -> str:
    """Say whether a model is a mip model."""
    if model.rendering.pixel_box:
        return "one of the pixel's box"
    return "a mip model" if model.rendering.compensate else "none"
