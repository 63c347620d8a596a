"""A grid of features: places of samples in it, features, and derivatives by its entries."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.cones import RAYS, Case, rows_of
from clsplat.conformance.comparison import GRADIENT, Figure, by_element, by_norm, equal
from clsplat.fields.encoding import Samples
from clsplat.fields.grid import FEATURES
from clsplat.fields.levels import Draw
from clsplat.fields.shape import SAMPLES
from clsplat.opencl.device import Device

CHECKS = Checks()
GRID: dict[str, Any] = {"levels": 3, "coarsest": 4, "finest": 19, "entries": 512, "corner": [-1.0, -1.1, -1.2], "side": 2.5}
CASES: list[tuple[int, dict[str, Any]]] = [
    *((count, {}) for count in RAYS),
    (9, {"levels": 1, "coarsest": 1, "finest": 1, "entries": 16}),  # one cell, all of its corners
    (9, {"entries": 16}),  # all levels share
    (9, {"entries": 8192}),  # none shares
    (9, {"corner": [500.0, 0.0, 0.0]}),  # no sample in the cube
    (9, {"finest": 4096}),  # finer than any sample
]


@CHECKS.add("grid_places", "grid_forward", "grid_backward")
def grids_of_features(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """What a network reads of a grid, and derivatives by its numbers."""
    for count, keys in CASES:
        grid = {**GRID, **keys}
        case = Case.of(device, rng, count, Draw(1, 2, 0), grid=grid, degrees=2)
        what = f"{count} rays, {grid['levels']} levels of {grid['entries']}, from {grid['corner'][0]:g}"
        level = next(case.levels.render(case.on_device, case.rays))
        expected = case.places(level.edges.get())
        tiles, encoding = level.raw_colours.shape[0], case.levels.encoding
        found = rows_of(encoding.places(tiles), 0, FEATURES).astype(np.float64)
        at, spread = found[:, :3], found[:, 3]
        yield by_element("grid_places", what, at, expected[0], 1e-5, 1.0)
        yield by_element("grid_places", f"variances of {what}", spread, expected[1], 1e-3)
        table, first = case.levels.network.position(tiles)
        features = rows_of(table, first, case.shape.grid_rows)
        by_features = rng.normal(size=(tiles, case.shape.grid_rows, SAMPLES)).astype(np.float32)
        by_features[:, :, ::3] = 0  # samples without a derivative
        gradients = list[NDArray[np.float32]]()
        for parts in (encoding.parts, 1, 3):
            encoding.parts, gradient = parts, device.zeros(case.shape.parameters)
            encoding.forward(case.on_device, Samples(case.rays.cones, level.edges))
            encoding.backward(device.upload(by_features), gradient)
            gradients.append(gradient.get())
        yield equal("grid_backward", f"sums in one part, {what}", gradients[1], gradients[0])
        yield equal("grid_backward", f"sums in three parts, {what}", gradients[2], gradients[0])
        by_sample = by_features.transpose(0, 2, 1).reshape(-1, case.shape.grid_rows).astype(np.float64)
        for number, own in enumerate(case.grid_levels()):
            rows = slice(FEATURES * number, FEATURES * (number + 1))
            wanted = own.level.forward(own.of(case.parameters), at, spread)
            yield by_element("grid_forward", f"level {number}, {what}", features[:, rows], wanted, 2e-5, 1.0)
            wanted = own.level.backward(by_sample[:, rows], at, spread)
            found = own.of(gradients[0])
            yield by_norm("grid_backward", f"level {number}, {what}", found, wanted, GRADIENT)
            yield equal("grid_backward", f"entries without samples, {number}, {what}", found[(wanted == 0).all(axis=1)], 0.0)
        yield equal("grid_backward", f"the network's, {what}", gradients[0][: case.shape.of_network], 0.0)
