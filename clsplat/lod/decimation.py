"""Fewer Gaussians by merging pairs of neighbours: the same model gives the same bytes, on the host and without
photographs.

Pairs come from the nearest neighbours of each Gaussian; the cheapest go first, and none is in two pairs.  A mixture
keeps mean, covariance and mass, opacity times surface, as in NanoGS (arXiv 2603.16103).  A pair costs

    ½ (log |Σ| - a log |Σa| - b log |Σb|) + |SHa - SHb|²

with the shares a + b = 1 of its mass: the bound of Runnalls (2007, eq. 16) on the Kullback-Leibler divergence that
merging causes, for a mass of 1, and the integral over all directions of the squared difference of the colours.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from clsplat.density.mixture import Floats, Mixtures, Rows, log_scales_of, mass_of, merged, surface
from clsplat.errors import ConfigError, DataError
from clsplat.formats.splats import not_finite, unit
from clsplat.gaussians.model import Model

NEIGHBOURS = 8  # of a Gaussian, among which its partner is
BLOCK = 1 << 16  # pairs whose costs are computed together
LOG_SCALES, LOGIT = (-17.0, 60.0), 80.0  # beyond which numbers that follow from them leave float64
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
    cost = pair_cost(tables, one, two)
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
    mass, size = mass_of(tables, surface), tables["log_scales"].sum(axis=1)  # of all rows: once, not for each block
    blocks = [slice(start, start + BLOCK) for start in range(0, len(first), BLOCK)]
    return np.concatenate([_block_cost(tables, mass, size, first[block], second[block]) for block in blocks])


def _block_cost(tables: Tables, mass: Floats, size: Floats, first: Rows, second: Rows) -> Floats:
    mixtures = Mixtures.of(tables, mass, first, second)
    share = mixtures.share[:, 0]
    variances = np.linalg.eigvalsh(mixtures.covariance).astype(np.float64)
    cost: Floats = log_scales_of(variances).sum(axis=1) - (1 - share) * size[first] - share * size[second]
    for name in ("sh_base", "sh_rest"):
        cost += np.square(tables[name][first] - tables[name][second]).sum(axis=1)
    return cost


def _neighbours(means: Floats) -> tuple[Rows, Rows]:
    """Pairs of a row and one of its nearest neighbours, the lower row first, each once and in ascending order.

    Of rows in one place, each has the next one, and the first one has neighbours in other places.
    """
    places, first, place = np.unique(means, axis=0, return_index=True, return_inverse=True)
    found = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(places)))[1].reshape(len(places), -1)
    one, two = first[np.repeat(np.arange(len(places)), found.shape[1])], first[found.ravel()]
    by_place = np.argsort(place.ravel(), kind="stable")
    same = np.diff(place.ravel()[by_place]) == 0
    one = np.concatenate([one, by_place[:-1][same]])
    two = np.concatenate([two, by_place[1:][same]])
    count, apart = len(means), one != two
    pairs = np.unique(np.minimum(one, two)[apart].astype(np.int64) * count + np.maximum(one, two)[apart])
    return pairs // count, pairs % count


def _settled(model: Model) -> Tables:
    """The tables in float64, with what the formulas can hold."""
    tables = {name: table.astype(np.float64) for name, table in model.tables().items()}
    tables["quats"] = unit(tables["quats"])
    tables["log_scales"] = np.clip(tables["log_scales"], *LOG_SCALES)
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
