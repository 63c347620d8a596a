"""Two Gaussians as one: the mean and covariance of their mixture, the mean of their colors, and their mass."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.core.quaternions import rotation_matrix, unit_quaternions
from clsplat.formats.splats import inverse_opacities

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Size = Callable[[Floats], Floats]  # of Gaussians, from their log scales [N, 3]: [N], up to a constant
THOMSEN = 1.6075  # exponent of Knud Thomsen's formula for the surface of an ellipsoid (2004), within 1.1 %
LEAST, MOST = 1e-6, 0.99  # opacities of mixtures; beyond 0.99 no renderer of 3DGS draws more


def volume(log_scales: Floats) -> Floats:
    """Return the volumes of ellipsoids over 4π/3, [N] scene units³."""
    found: Floats = np.exp(log_scales.sum(axis=1))
    return found


def surface(log_scales: Floats) -> Floats:
    """Return the surfaces of ellipsoids over 4π, [N] scene units², by Thomsen's formula."""
    products = (log_scales.sum(axis=1, keepdims=True) - log_scales) * THOMSEN
    found: Floats = np.exp(products).mean(axis=1) ** (1 / THOMSEN)
    return found


def mass_of(tables: dict[str, Floats], size: Size = volume) -> Floats:
    """Return opacity times size, [N]."""
    mass: Floats = size(tables["log_scales"]) / inverse_opacities(tables["logit_opacity"][:, 0])
    return mass


@dataclass(frozen=True)
class Mixtures:
    """The moments of pairs of Gaussians, each weighted by its mass."""

    mass: Floats  # [pairs], of both
    share: Floats  # [pairs, 1], of the second
    means: Floats  # [pairs, 3] scene units
    covariance: Floats  # [pairs, 3, 3] scene units²

    @classmethod
    def of(cls, tables: dict[str, Floats], mass: Floats, first: Rows, second: Rows) -> "Mixtures":
        """Return those of rows `first` and `second`, [pairs]; mass: of all rows, as `mass_of` returns it."""
        total = mass[first] + mass[second]
        share = (mass[second] / total)[:, None]
        means = (1 - share) * tables["means"][first] + share * tables["means"][second]
        covariance = np.zeros((len(first), 3, 3))
        for rows, weight in ((first, 1 - share), (second, share)):
            offset = tables["means"][rows] - means
            own = covariance_of(tables["quats"][rows], tables["log_scales"][rows])
            covariance += weight[:, :, None] * (own + offset[:, :, None] * offset[:, None, :])
        return cls(total, share, means, covariance)

    def opacity(self, log_scales: Floats, size: Size = volume) -> Floats:
        """Return the opacities that keep the mass, [pairs], within what is drawn."""
        return np.clip(self.mass / size(log_scales), LEAST, MOST)


def merged(tables: dict[str, Floats], first: Rows, second: Rows, size: Size = volume) -> dict[str, Floats]:
    """Return Gaussians with mean and covariance of mixtures of `first` and `second`, by parameter, [pairs, ...]."""
    mixtures = Mixtures.of(tables, mass_of(tables, size), first, second)
    share = mixtures.share
    variances, axes = np.linalg.eigh(mixtures.covariance)  # scene units²
    log_scales = log_scales_of(variances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
    opacity = mixtures.opacity(log_scales, size)
    colors = {name: (1 - share) * tables[name][first] + share * tables[name][second] for name in ("sh_base", "sh_rest")}
    return {
        "means": mixtures.means,
        "quats": unit_quaternions(axes),
        "log_scales": log_scales,
        "logit_opacity": np.log(opacity / (1 - opacity))[:, None],
        **colors,
    }


def log_scales_of(variances: Floats) -> Floats:
    """Return log scales of variances along the axes, scene units²."""
    return np.asarray(0.5 * np.log(np.maximum(variances, 1e-30)))


def covariance_of(quats: Floats, log_scales: Floats) -> Floats:
    """Return R diag(s²) Rᵀ, [N, 3, 3] scene units²."""
    rotations = rotation_matrix(*(quats / np.linalg.norm(quats, axis=1, keepdims=True)).T)
    axes = rotations * np.exp(log_scales)[:, None, :]
    covariance: Floats = np.einsum("nij,nkj->nik", axes, axes)
    return covariance
