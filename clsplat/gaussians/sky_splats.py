"""A sky as Gaussians on a far sphere, for programs that know no map of directions."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.model import Model
from clsplat.gaussians.motion import still
from clsplat.gaussians.octahedral import sampled
from clsplat.gaussians.tables import SH_C0

COUNT = 10_000  # Gaussians, 2 degrees from each other
RADIUS = 10.0  # of the sphere, by the distance that holds SHARE of the model (WildGaussians, Kulhanek et al. 2024)
SHARE = 0.97
WIDTH = 0.65  # standard deviation, by the distance of neighbours: gaps let 2 % through (ours)
FLAT = 0.1  # standard deviation along the ray, by that across
LOGIT = 6.0  # of the opacity


def with_sky_splats(model: Model, count: int = COUNT) -> Model:
    """Return a model without a sky, and with Gaussians in its place; one without a sky stays as it is."""
    if (sky := model.sky) is None:
        return model
    model = model.baked()
    means = model.means.astype(np.float64)
    centre = np.median(means, axis=0)
    radius = RADIUS * float(np.quantile(np.linalg.norm(means - centre, axis=1), SHARE))
    directions = fibonacci(count)
    across = np.log(radius * np.sqrt(4 * np.pi / count) * WIDTH)
    added: dict[str, NDArray[Any]] = {
        "means": centre + radius * directions,
        "quats": _turns(directions),
        "log_scales": np.tile([across, across, across + np.log(FLAT)], (count, 1)),
        "logit_opacity": np.full((count, 1), LOGIT),
        "sh_base": (np.clip(sampled(sky.texels, directions), 0, 1) - 0.5) / SH_C0,
        "sh_rest": np.zeros((count, model.sh_rest.shape[1])),
    }
    tables: dict[str, Any] = {name: np.concatenate([getattr(model, name), rows]) for name, rows in added.items()}
    if model.motion is not None:
        tables["motion"] = np.concatenate([model.motion, still(count, model.motion.shape[1])])
    notes = {**model.rendering.notes, "sky": "splats"}
    return replace(model, **tables, rendering=replace(model.rendering, notes=notes), sky=None)


def fibonacci(count: int) -> NDArray[np.float64]:
    """Return directions that lie evenly on a sphere, unit vectors, [count, 3]."""
    number = np.arange(count)
    z = 1 - (2 * number + 1) / count
    angle = number * np.pi * (3 - np.sqrt(5))
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)


def _turns(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions, [N, 4], that turn the z axis into unit vectors."""
    x, y, z = directions.T
    return np.stack([1 + z, -y, x, np.zeros_like(x)], axis=1)
