"""A grid of features: places of samples in it, features, and derivatives by its entries."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.cones import RAYS, Case, rows_of
from clsplat.conformance.comparison import GRADIENT, Figure, by_element, by_norm, equal
from clsplat.fields.encoding import PLACE_ROWS
from clsplat.fields.grid import FEATURES
from clsplat.fields.levels import Draw
from clsplat.fields.shape import SAMPLES
from clsplat.opencl.device import Device

CHECKS = Checks()
GRID: dict[str, Any] = {
    "levels": 3,
    "coarsest": 4,
    "finest": 19,
    "entries": 512,
    "corner": [-1.0, -1.1, -1.2],
    "side": 2.5,
}
CASES: list[tuple[int, tuple[float, float], dict[str, Any]]] = [  # tiles, places along an axis, keys of the grid
    *((tiles, (-0.1, 1.1), {}) for tiles in (1, 2, 17)),
    (2, (0.0, 1.0), {"levels": 1, "coarsest": 1, "finest": 1, "entries": 16}),  # one cell, all of its corners
    (2, (-0.1, 1.1), {"entries": 16}),  # all levels share
    (2, (-0.1, 1.1), {"entries": 8192}),  # none shares
    (2, (1.1, 2.0), {}),  # no sample in the cube
    (2, (0.0, 1.0), {"finest": 4096}),  # finer than most samples
]


@CHECKS.add("grid_places", "grid_forward", "grid_backward")
def grids_of_features(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """Where samples are in a grid, what a network reads of it there, and derivatives by its numbers."""
    for count in RAYS:
        case = Case.of(device, rng, count, Draw(1, 2, 0), grid=GRID)
        level = next(case.levels.render(case.on_device, case.rays))
        at, variances = case.places(level.edges.get())
        found = rows_of(case.levels.encoding.places(level.raw_colours.shape[0]), 0, PLACE_ROWS)
        yield by_element("grid_places", f"means of {count} rays", found[:, :3], at, 1e-5, 1.0)
        yield by_element("grid_places", f"variances of {count} rays", found[:, 3], variances, 1e-3)
    for tiles, ends, keys in CASES:
        case = Case.of(device, rng, 1, Draw(1, 2, 0), grid={**GRID, **keys}, degrees=2)
        yield from _grid_figures(device, rng, case, _places(rng, tiles, ends))


def _places(rng: np.random.Generator, tiles: int, ends: tuple[float, float]) -> NDArray[np.float32]:
    """Random samples of all sizes, [tiles, PLACE_ROWS, SAMPLES]; a sixth of the means lie on faces of cells."""
    at = rng.uniform(*ends, (tiles, 3, SAMPLES))
    faces = np.where(rng.random(at.shape) < 1 / 6, np.rint(4 * at) / 4, at)
    return np.concatenate([faces, 10.0 ** rng.uniform(-9, 0, (tiles, 1, SAMPLES))], axis=1).astype(np.float32)


def _by_sample(table: NDArray[np.float32]) -> NDArray[np.float64]:
    """[tiles, rows, SAMPLES] -> [S, rows]."""
    return table.transpose(0, 2, 1).reshape(-1, table.shape[1]).astype(np.float64)


def _grid_figures(
    device: Device, rng: np.random.Generator, case: Case, places: NDArray[np.float32]
) -> Iterator[Figure]:
    shape, encoding, tiles = case.shape, case.levels.encoding, len(places)
    assert shape.grid is not None
    what = f"{tiles} tiles, {shape.grid.levels} levels to {shape.grid.finest} with {shape.grid.entries}"
    encoding.places(tiles).set(places)
    encoding.read_grid(case.on_device, tiles)
    table, first = case.levels.network.position(tiles)
    features = rows_of(table, first, shape.grid_rows)
    by_features = rng.normal(size=(tiles, shape.grid_rows, SAMPLES)).astype(np.float32)
    by_features[:, :, ::3] = 0  # samples without derivatives
    gradients = list[NDArray[np.float32]]()
    for parts in (encoding.parts, 1, 3):
        encoding.parts, sums = parts, device.zeros(shape.parameters)
        encoding.backward(device.upload(by_features), sums)
        gradients.append(sums.get())
    found, *others = gradients
    for parts, gradient in zip((1, 3), others, strict=True):
        yield equal("grid_backward", f"sums in {parts} of its parts, {what}", gradient, found)
    by_sample = _by_sample(by_features)
    at, variances = np.split(_by_sample(places), [3], axis=1)
    variances = variances[:, 0]
    for number, own in enumerate(case.grid_levels()):
        rows = slice(FEATURES * number, FEATURES * (number + 1))
        wanted = own.level.forward(own.of(case.parameters), at, variances)
        yield by_element("grid_forward", f"level {number}, {what}", features[:, rows], wanted, 5e-5, 1.0)
        wanted, by_entries = own.level.backward(by_sample[:, rows], at, variances), own.of(found)
        yield by_norm("grid_backward", f"level {number}, {what}", by_entries, wanted, GRADIENT)
        untouched = np.all(wanted == 0, axis=1)
        yield equal("grid_backward", f"entries without samples, level {number}, {what}", by_entries[untouched], 0.0)
    yield equal("grid_backward", f"parameters of the network, {what}", found[: shape.of_network], 0.0)
