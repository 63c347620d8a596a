"""Merge pairs of Gaussians, preserving the mean, covariance, mean color, and mass of their mixture."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsplat.core.errors import DataError
from clsplat.core.quaternions import rotation_matrix, unit_quaternions
from clsplat.formats.splats import inverse_opacities, normalize_quats, not_finite
from clsplat.gaussians.model import Model

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


# Fewer Gaussians, by merging neighbors.

NEIGHBORS = 8  # candidates for merging with a Gaussian
BLOCK = 1 << 16  # pairs per batch of costs
LOG_SCALES, LOGIT = (-17.0, 60.0), 80.0  # limits that keep derived values within float64
Tables = dict[str, Floats]


def merge_neighbors(model: Model, count: int) -> Model:
    """Merge neighbors until at most `count` Gaussians remain, with the same total mass and mean.

    The world filter is baked into the result.  Raises DataError for values that are not finite.
    """
    baked_model = model.baked()
    if invalid_count := int(not_finite(baked_model.tables()).sum()):
        raise DataError(f"{invalid_count} Gaussians have values that are not finite; drop them with `clsplat convert`")
    if len(baked_model) <= count:
        return baked_model
    tables = _clipped_tables(baked_model)
    while (total := len(tables["means"])) > count:
        first, second = match_pairs(tables)
        tables = _merge_pairs(tables, first[: total - count], second[: total - count])
    arrays: dict[str, Any] = {name: table.astype(np.float32) for name, table in tables.items()}
    return replace(baked_model, **arrays)


def match_pairs(tables: Tables) -> tuple[Rows, Rows]:
    """Return disjoint pairs of rows, the cheapest first.  There is at least one pair if there are at least two rows."""
    first, second = _find_neighbors(tables["means"])
    cost = pair_cost(tables, first, second)
    order = np.lexsort((second, first, np.where(np.isfinite(cost), cost, np.inf)))
    is_free = bytearray(b"\1") * len(tables["means"])
    selected_rows = []
    for start in range(0, len(order), BLOCK):
        batch = order[start : start + BLOCK]
        for pair, i, j in zip(batch.tolist(), first[batch].tolist(), second[batch].tolist(), strict=True):
            if is_free[i] and is_free[j]:
                is_free[i] = is_free[j] = 0
                selected_rows.append(pair)
    return first[selected_rows], second[selected_rows]


def pair_cost(tables: Tables, first: Rows, second: Rows) -> Floats:
    """Return the cost of merging each pair, [pairs].  Swapping `first` and `second` changes it only by rounding."""
    mass, log_volume = masses(tables, surface), tables["log_scales"].sum(axis=1)  # of all rows, computed once
    blocks = [slice(start, start + BLOCK) for start in range(0, len(first), BLOCK)]
    return np.concatenate([_block_cost(tables, mass, log_volume, first[block], second[block]) for block in blocks])


def _block_cost(tables: Tables, mass: Floats, log_volume: Floats, first: Rows, second: Rows) -> Floats:
    mixtures = Mixtures.from_pairs(tables, mass, first, second)
    fraction = mixtures.fraction[:, 0]
    variances = np.linalg.eigvalsh(mixtures.covariance).astype(np.float64)
    cost: Floats = (
        to_log_scales(variances).sum(axis=1) - (1 - fraction) * log_volume[first] - fraction * log_volume[second]
    )
    for name in ("sh_base", "sh_rest"):
        cost += np.square(tables[name][first] - tables[name][second]).sum(axis=1)
    return cost


def _find_neighbors(means: Floats) -> tuple[Rows, Rows]:
    """Return unique pairs of rows that are nearest neighbors, lower row first, in ascending order.

    Rows at the same position are paired as a chain, and only the first row of a chain has neighbors elsewhere.
    """
    positions, first_row, position_index = np.unique(means, axis=0, return_index=True, return_inverse=True)
    count = len(positions)
    nearest_indices = cKDTree(positions).query(positions, k=min(NEIGHBORS + 1, count))[1].reshape(count, -1)
    row, neighbor = first_row[np.repeat(np.arange(count), nearest_indices.shape[1])], first_row[nearest_indices.ravel()]
    order = np.argsort(position_index.ravel(), kind="stable")
    is_same = np.diff(position_index.ravel()[order]) == 0
    row = np.concatenate([row, order[:-1][is_same]])
    neighbor = np.concatenate([neighbor, order[1:][is_same]])
    count, is_pair = len(means), row != neighbor
    pairs = np.unique(np.minimum(row, neighbor)[is_pair].astype(np.int64) * count + np.maximum(row, neighbor)[is_pair])
    return pairs // count, pairs % count


def _clipped_tables(model: Model) -> Tables:
    """Return float64 tables with unit quaternions, and values clipped so that no derived value overflows."""
    tables = {name: table.astype(np.float64) for name, table in model.tables().items()}
    tables["quats"] = normalize_quats(tables["quats"])
    tables["log_scales"] = np.clip(tables["log_scales"], *LOG_SCALES)
    tables["logit_opacity"] = np.clip(tables["logit_opacity"], -LOGIT, LOGIT)
    return tables


def _merge_pairs(tables: Tables, first: Rows, second: Rows) -> Tables:
    """Return the tables with each pair merged into its row of `first`, and the rows `second` removed."""
    is_remaining = np.ones(len(tables["means"]), bool)
    is_remaining[second] = False
    mixtures = merge(tables, first, second, surface)
    for name, values in mixtures.items():
        tables[name][first] = values
    return {name: table[is_remaining] for name, table in tables.items()}
