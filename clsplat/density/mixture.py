"""Merge pairs of Gaussians, preserving the mean, covariance, mean color, and mass of their mixture."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.core.quaternions import rotation_matrix, unit_quaternions
from clsplat.formats.splats import inverse_opacities

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Size = Callable[[Floats], Floats]  # log scales, [N, 3] -> size, [N], up to a constant factor
THOMSEN = 1.6075  # exponent of Knud Thomsen's formula for the surface of an ellipsoid (2004), error at most 1.1 %
MIN_OPACITY, MAX_OPACITY = 1e-6, 0.99  # renderers of 3DGS clamp alpha at 0.99


def volume(log_scales: Floats) -> Floats:
    """Return the volumes of ellipsoids divided by 4π/3, [N] scene units³."""
    result: Floats = np.exp(log_scales.sum(axis=1))
    return result


def surface(log_scales: Floats) -> Floats:
    """Return the surface areas of ellipsoids divided by 4π, [N] scene units², by Thomsen's formula."""
    products = (log_scales.sum(axis=1, keepdims=True) - log_scales) * THOMSEN
    result: Floats = np.exp(products).mean(axis=1) ** (1 / THOMSEN)
    return result


def masses(tables: dict[str, Floats], size_of: Size = volume) -> Floats:
    """Return the mass of each Gaussian, its opacity times its size (`volume` or `surface`), [N]."""
    mass: Floats = size_of(tables["log_scales"]) / inverse_opacities(tables["logit_opacity"][:, 0])
    return mass


@dataclass(frozen=True)
class Mixtures:
    """The moments of mixtures of two Gaussians, weighted by mass."""

    mass: Floats  # [pairs] of both Gaussians together
    fraction: Floats  # [pairs, 1] mass of the second Gaussian, divided by the mass of both
    means: Floats  # [pairs, 3] scene units
    covariance: Floats  # [pairs, 3, 3] scene units²

    @classmethod
    def from_pairs(cls, tables: dict[str, Floats], mass: Floats, first: Rows, second: Rows) -> "Mixtures":
        """Compute the mixtures of rows `first` and `second`, [pairs] each.  mass: [N] of all rows; see `masses`."""
        total = mass[first] + mass[second]
        fraction = (mass[second] / total)[:, None]
        means = (1 - fraction) * tables["means"][first] + fraction * tables["means"][second]
        covariance = np.zeros((len(first), 3, 3))
        for rows, weight in ((first, 1 - fraction), (second, fraction)):
            offset = tables["means"][rows] - means
            covariances = covariance_matrices(tables["quats"][rows], tables["log_scales"][rows])
            covariance += weight[:, :, None] * (covariances + offset[:, :, None] * offset[:, None, :])
        return cls(total, fraction, means, covariance)

    def opacity(self, log_scales: Floats, size_of: Size = volume) -> Floats:
        """Return the opacities that preserve the mass, [pairs], clamped to MIN_OPACITY and MAX_OPACITY."""
        return np.clip(self.mass / size_of(log_scales), MIN_OPACITY, MAX_OPACITY)


def merge(tables: dict[str, Floats], first: Rows, second: Rows, size_of: Size = volume) -> dict[str, Floats]:
    """Merge rows `first` and `second`, [pairs] each, into Gaussians with the mean and covariance of their mixtures.

    Returns tables of the shape [pairs, components], by parameter.
    """
    mixtures = Mixtures.from_pairs(tables, masses(tables, size_of), first, second)
    fraction = mixtures.fraction
    variances, axes = np.linalg.eigh(mixtures.covariance)  # scene units²
    log_scales = to_log_scales(variances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, not a reflection
    opacity = mixtures.opacity(log_scales, size_of)
    harmonics = {name: tables[name] for name in ("sh_base", "sh_rest")}
    colors = {name: (1 - fraction) * table[first] + fraction * table[second] for name, table in harmonics.items()}
    return {
        "means": mixtures.means,
        "quats": unit_quaternions(axes),
        "log_scales": log_scales,
        "logit_opacity": np.log(opacity / (1 - opacity))[:, None],
        **colors,
    }


def to_log_scales(variances: Floats) -> Floats:
    """Convert variances along the axes, [N, 3] scene units², to log scales."""
    return np.asarray(0.5 * np.log(np.maximum(variances, 1e-30)))


def covariance_matrices(quats: Floats, log_scales: Floats) -> Floats:
    """Return the covariance matrices R diag(s²) Rᵀ, [N, 3, 3] in scene units²."""
    rotations = rotation_matrix(*(quats / np.linalg.norm(quats, axis=1, keepdims=True)).T)
    axes = rotations * np.exp(log_scales)[:, None, :]
    result: Floats = np.einsum("nij,nkj->nik", axes, axes)
    return result
