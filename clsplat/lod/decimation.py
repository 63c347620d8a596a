"""Fewer Gaussians by merging pairs of neighbours: the same model gives the same bytes, on the host and without
photographs.

Pairs come from the nearest neighbours of each Gaussian; the cheapest go first, and none is in two pairs.  A mixture
keeps mean, covariance and mass, opacity times surface, as in NanoGS (arXiv 2603.16103).  A pair costs what the mixture
changes: the integral over space of the squared difference of the fields Σ α c G(x), c = (1, red, green, blue), where

    ∫ Ga Gb = (2π)^(3/2) (|Σa| |Σb| / |Σa + Σb|)^(1/2) exp(-½ dᵀ (Σa + Σb)⁻¹ d)

over the cube root of the mixture's volume, for a picture shows areas.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from clsplat.density.mixture import Floats, Mixtures, Rows, covariance_of, log_scales_of, merged, surface
from clsplat.errors import ConfigError, DataError
from clsplat.formats.splats import not_finite, opacities, unit
from clsplat.gaussians.model import Model
from clsplat.gaussians.tables import SH_C0

NEIGHBOURS = 8  # of a Gaussian, among which its partner is
BLOCK = 1 << 16  # pairs whose costs are computed together
LOG_SCALE, LOGIT = 60.0, 80.0  # beyond which numbers that follow from them leave float64
THIN = 1e-8  # share of the largest variance that is added to all: discs have an inverse
Tables = dict[str, Floats]


def decimated(model: Model, keep: float = 0.5) -> Model:
    """Return a model with a share of the Gaussians, one at least, of which neighbours are merged.

    A world filter is baked.  Raises ConfigError for what is no share, DataError for values that are not finite.
    """
    if not 0 < keep <= 1:
        raise ConfigError(f"--keep {keep:g}: expected a share of the Gaussians above 0, up to 1")
    plain = model.baked()
    if bad := int(not_finite(plain.tables()).sum()):
        raise DataError(f"{bad} Gaussians hold values that are not finite; drop them with `clsplat convert`")
    target = min(len(plain), max(1, int(keep * len(plain) + 0.5)))
    if target == len(plain):
        return plain
    tables = _settled(plain)
    while (count := len(tables["means"])) > target:
        first, second = matched(tables)
        tables = _joined(tables, first[: count - target], second[: count - target])
    fewer: dict[str, Any] = {name: table.astype(np.float32) for name, table in tables.items()}
    return replace(plain, **fewer)


def matched(tables: Tables) -> tuple[Rows, Rows]:
    """Return pairs of rows, the cheapest first, of which none shares a row: one at least, where there are two rows."""
    one, two = _neighbours(tables["means"])
    cost = np.concatenate(
        [pair_cost(tables, one[i : i + BLOCK], two[i : i + BLOCK]) for i in range(0, len(one), BLOCK)]
    )
    order = np.lexsort((two, one, np.where(np.isfinite(cost), cost, np.inf)))
    free = bytearray(b"\1") * len(tables["means"])
    chosen = []
    for start in range(0, len(order), BLOCK):
        some = order[start : start + BLOCK]
        for at, i, j in zip(some.tolist(), one[some].tolist(), two[some].tolist(), strict=True):
            if free[i] and free[j]:
                free[i] = free[j] = 0
                chosen.append(at)
    return one[chosen], two[chosen]


def pair_cost(tables: Tables, first: Rows, second: Rows) -> Floats:
    """Return what merging changes, [pairs]; symmetric in the pair up to rounding."""
    mixtures = Mixtures.of(tables, first, second, surface)
    size = log_scales_of(np.asarray(np.linalg.eigvalsh(mixtures.covariance), np.float64))
    share = mixtures.share
    colours = np.maximum(0.5 + SH_C0 * tables["sh_base"], 0)
    colour = np.concatenate([np.ones((len(colours), 1)), colours], axis=1)
    opacity = opacities(tables["logit_opacity"][:, :1])
    fields = [
        (
            opacity[rows] * colour[rows],
            tables["means"][rows],
            covariance_of(tables["quats"][rows], tables["log_scales"][rows]),
        )
        for rows in (first, second)
    ]
    mean_colour = (1 - share) * colour[first] + share * colour[second]
    fields.append((-mixtures.opacity(size, surface)[:, None] * mean_colour, mixtures.means, mixtures.covariance))
    error = np.zeros(len(first))
    for a, (weight, mean, covariance) in enumerate(fields):
        for b, (other_weight, other_mean, other_covariance) in enumerate(fields[: a + 1]):
            overlap = _overlap(mean - other_mean, covariance, other_covariance)
            error += (1 if a == b else 2) * (weight * other_weight).sum(axis=1) * overlap
    cost: Floats = error / np.exp(size.mean(axis=1))
    return cost


def _overlap(apart: Floats, one: Floats, two: Floats) -> Floats:
    """The integral of the product of two Gaussians of height 1, [pairs], over (2π)^(3/2)."""
    thick = THIN * np.maximum(np.trace(one, axis1=1, axis2=2), np.trace(two, axis1=1, axis2=2))
    one, two = (part + thick[:, None, None] * np.eye(3) for part in (one, two))
    both = one + two
    distance = (apart * np.linalg.solve(both, apart[:, :, None])[:, :, 0]).sum(axis=1)
    ratio = np.linalg.det(one) * np.linalg.det(two) / np.linalg.det(both)
    found: Floats = np.sqrt(np.maximum(ratio, 0)) * np.exp(-0.5 * distance)
    return found


def _neighbours(means: Floats) -> tuple[Rows, Rows]:
    """Pairs of a row and one of its nearest neighbours, the lower row first, each once and in ascending order."""
    count = len(means)
    found = cKDTree(means).query(means, k=min(NEIGHBOURS + 1, count))[1]
    rows = np.broadcast_to(np.arange(count)[:, None], found.shape)
    apart = found != rows  # of many in one place, the row itself may be missing
    low, high = np.minimum(found, rows)[apart], np.maximum(found, rows)[apart]
    pairs = np.unique(low.astype(np.int64) * count + high)
    return pairs // count, pairs % count


def _settled(model: Model) -> Tables:
    """The tables in float64, with what the formulas can hold."""
    tables = {name: table.astype(np.float64) for name, table in model.tables().items()}
    tables["quats"] = unit(tables["quats"])
    tables["log_scales"] = np.clip(tables["log_scales"], -LOG_SCALE, LOG_SCALE)
    tables["logit_opacity"] = np.clip(tables["logit_opacity"], -LOGIT, LOGIT)
    return tables


def _joined(tables: Tables, first: Rows, second: Rows) -> Tables:
    """The tables with mixtures at the rows `first`, and without the rows `second`."""
    kept = np.ones(len(tables["means"]), bool)
    kept[second] = False
    mixtures = merged(tables, first, second, surface)
    for name, values in mixtures.items():
        tables[name][first] = values
    return {name: table[kept] for name, table in tables.items()}
