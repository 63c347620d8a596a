"""A field: its network, colours of rays, all derivatives, pictures and updates."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.cones import BACKGROUND, HEIGHT, RAYS, SHAPE, WIDTH, Case, rows_of
from clsplat.conformance.checks.grids import GRID
from clsplat.conformance.comparison import GRADIENT, SUM, Figure, by_element, by_norm, equal
from clsplat.conformance.reference import field as ref_field
from clsplat.fields.field import Field
from clsplat.fields.grid import FEATURES
from clsplat.fields.levels import Draw, Level, Target
from clsplat.fields.shape import FieldShape
from clsplat.opencl.device import Device
from clsplat.training.field import AdamStep, LearnedField

CHECKS = Checks()
CASES: list[tuple[int, dict[str, Any]]] = [
    *((count, {}) for count in RAYS),
    *((9, keys) for keys in ({"skip": None, "depth": 1}, {"degrees": 3}, {"skip": 0})),
    *((9, {"grid": GRID, **keys}) for keys in ({}, {"skip": None, "depth": 1, "degrees": 0})),
]


@CHECKS.add(
    *("dense_forward", "dense_backward", "dense_weights", "dense_biases", "dense_sums"),
    *("composite_forward", "composite_backward"),
)
def fields(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """Colours of rays and derivatives by all parameters, through both levels."""
    for count, keys in CASES:
        case = Case.of(device, rng, count, Draw(3, 4, 2), **keys)
        gradient = device.zeros(case.shape.parameters)
        errors, expected = device.zeros(2 + count), list[ref_field.Weights]()
        by_entries = [np.zeros_like(own.of(case.parameters)) for own in case.grid_levels()]
        parameters = case.on_device
        for scale, level in zip((0.1, 1.0), case.levels.render(parameters, case.rays), strict=True):
            comparison = _Comparison.of(case, level, scale)
            yield from comparison.figures(f"{count} rays, {level.samples} samples")
            case.levels.differentiate(parameters, level, Target(case.planes, scale, errors), gradient)
            squares = (comparison.differences[:count] ** 2).sum(axis=1)
            yield by_element("composite_backward", f"squares of {count} rays", errors.get()[2:], squares, SUM, 1e-3)
            by_weights, by_position = comparison.backward(count)
            expected.append(by_weights)
            for number, own in enumerate(case.grid_levels()):
                by_features = by_position[:, FEATURES * number : FEATURES * (number + 1)]
                by_entries[number] += own.level.backward(by_features, *case.places(level.edges.get()))
        for number, (own, wanted) in enumerate(zip(case.grid_levels(), by_entries, strict=True)):
            what = f"level {number} of the grid, {count} rays, skip {case.shape.skip}"
            for name in ("dense_backward", "grid_backward"):
                yield by_norm(name, what, own.of(gradient.get()), wanted, GRADIENT)
        yield from _gradient_figures(case.shape, gradient.get(), expected, f"{count} rays")


def _gradient_figures(
    shape: FieldShape, gradient: NDArray[Any], expected: list[ref_field.Weights], what: str
) -> Iterator[Figure]:
    gradient = gradient[: shape.of_network]
    used = np.zeros(shape.of_network, bool)
    for number, (layer, (weights, biases)) in enumerate(zip(shape.layers, shape.weights(gradient), strict=True)):
        of_weights, of_biases = (sum(level[number][part] for level in expected) for part in (0, 1))
        kernel = "composite_backward" if layer.name in ("density", "colour") else "dense_backward"
        for name in (kernel, "dense_weights", "dense_sums"):
            yield by_norm(name, f"weights of {layer.name}, {what}", weights, np.asarray(of_weights), GRADIENT)
        yield by_norm("dense_biases", f"biases of {layer.name}, {what}", biases, np.asarray(of_biases), GRADIENT)
        table = used[layer.first : layer.first_bias].reshape(layer.rows, layer.columns)
        table[np.ix_(layer.inputs, range(layer.outputs))] = True
        used[layer.first_bias : layer.first_bias + layer.outputs] = True
    yield equal("dense_sums", f"what fills blocks, {what}", gradient[~used], 0.0)


@dataclass(frozen=True)
class _Comparison:
    """A level in double precision."""

    level: Level
    scale: float
    network: ref_field.Network
    weights: ref_field.Weights
    raw: tuple[NDArray[np.float64], NDArray[np.float64]]
    inputs: ref_field.Inputs
    composite: ref_field.Composite
    differences: NDArray[np.float64]

    @classmethod
    def of(cls, case: Case, level: Level, scale: float) -> "_Comparison":
        network, weights = ref_field.Network(case.shape.depth, case.shape.skip), case.shape.weights(case.parameters)
        edges, samples = level.edges.get().astype(np.float64), level.samples
        colours, densities, inputs = network.forward(weights, *case.encoded(edges))
        lengths = np.diff(edges, axis=1) * case.cones[:, 7:8]
        composite = ref_field.Composite(
            colours.reshape(-1, samples, 3), densities.reshape(-1, samples), lengths, BACKGROUND.astype(np.float64)
        )
        differences = composite.colours()
        differences[: case.rays.counted] -= case.wanted()
        return cls(level, scale, network, weights, (colours, densities), inputs, composite, differences)

    def figures(self, what: str) -> Iterator[Figure]:
        colours, densities = (
            rows_of(table, 0, count) for table, count in ((self.level.raw_colours, 3), (self.level.raw_densities, 1))
        )
        for name, found, expected in (("colours", colours, self.raw[0]), ("densities", densities, self.raw[1])):
            yield by_element("dense_forward", f"raw {name}, {what}", found, expected, 1e-4, 1.0)
        weights, left = self.composite.weights()
        for name, table, wanted in (("weights", self.level.weights, weights), ("left", self.level.left, left)):
            yield by_element("composite_forward", f"{name}, {what}", table.get(), wanted, 1e-4, 1.0)
        yield by_element("composite_forward", what, self.level.colours.get(), self.composite.colours(), 1e-4, 1.0)

    def backward(self, counted: int) -> tuple[ref_field.Weights, NDArray[np.float64]]:
        by_colours = 2 * self.scale * self.differences
        by_colours[counted:] = 0
        by_raw, by_densities = self.composite.backward(by_colours)
        return self.network.backward(self.weights, self.inputs, by_raw.reshape(-1, 3), by_densities.reshape(-1, 1))


@CHECKS.add("place_colours")
def pictures_of_fields(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """A whole picture: the pixels in their places, zeros around them."""
    case = Case.of(device, rng, 1, Draw(0, 1, 0))
    field = Field(case.shape, case.on_device, device.upload(BACKGROUND))
    pixels = np.arange(WIDTH * HEIGHT, dtype=np.uint32)
    *_, fine = case.levels.render(case.on_device, case.levels.cast(case.rays.camera, device.upload(pixels)))
    expected = np.zeros((3, case.rays.camera.rows, case.rays.camera.stride), np.float32)
    expected[:, :HEIGHT, :WIDTH] = fine.colours.get()[: len(pixels)].T.reshape(3, HEIGHT, WIDTH)
    yield equal("place_colours", f"a picture of {WIDTH} x {HEIGHT}", field.paint(case.rays.camera).get(), expected)


@CHECKS.add("dense_update")
def updates_of_fields(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """Adam, over some updates of gradients of all sizes."""
    learned = LearnedField.first(SHAPE, 0, device.upload(BACKGROUND))
    count = SHAPE.parameters
    values, moment1, moment2 = SHAPE.first_parameters(0).astype(np.float64), np.zeros(count), np.zeros(count)
    for number, epsilon in enumerate((1e-8, 1e-8, 1e-15), 1):
        gradient = (rng.normal(size=count) * 10.0 ** rng.uniform(-10, 1, count)).astype(np.float32)
        learned.update(device.upload(gradient), AdamStep(0.01, epsilon), number)
        own = gradient.astype(np.float64)
        values, moment1, moment2 = ref_field.update(values, moment1, moment2, own, 0.01, number, epsilon)
    found = learned.tables()
    yield by_element("dense_update", "parameters", found["parameters"][:, 0], values, 1e-4, 0.01)
    yield by_element("dense_update", "first moments", found["moment1"][:, 0], moment1, 1e-4, 1e-12)
    yield by_element("dense_update", "second moments", found["moment2"][:, 0], moment2, 1e-4, 1e-24)
