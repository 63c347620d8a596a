"""Check NeRF fields: pixel cones, samples, encodings, the network, composited colors, and updates."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Results, Tol, compare, compare_max, match
from clsplat.conformance.checks.images import to_planes
from clsplat.conformance.reference import nerf as ref
from clsplat.conformance.reference.training import adam_step
from clsplat.conformance.scenes import random_case
from clsplat.nerf.field import Field, RandomKey, RayRenderer, Rays, RayTarget, SampleLevel
from clsplat.nerf.network import PLACE_ROWS
from clsplat.nerf.shape import FEATURES, SAMPLES, FieldShape
from clsplat.nerf.training import AdamStep, LearnedField
from clsplat.opencl.device import Array, Device

CHECKS = Checks()
RAYS = (1, 63, 64, 65)  # around the size of a tile of samples and a chunk of tiles
SHAPE = FieldShape(
    unit=0.8,
    near=0.2,
    depth=3,
    width=16,
    skip=1,
    color_width=12,
    degrees=5,
    direction_degrees=2,
    coarse_samples=16,
    fine_samples=32,
)
BACKGROUND = np.array([1.0, 0.7, 0.4], np.float32)
WIDTH, HEIGHT = 19, 13
ENCODING = 4e-5  # bound on a sine: 2^4 times a distance of about 6, in float32
EDGES = 2e-6  # bound on distances, relative to the largest


@dataclass(frozen=True)
class GridLevel:
    """A level of a hash grid, and the index of its first entry in the parameters."""

    level: ref.HashLevel
    first: int

    def entries(self, parameters: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the level's entries, [entries, FEATURES], from the parameters of the field."""
        values = parameters[self.first : self.first + FEATURES * self.level.entries]
        return values.reshape(-1, FEATURES).astype(np.float64)


@dataclass(frozen=True)
class FieldCase:
    """A field with random parameters, and rays of a camera with a random photograph."""

    shape: FieldShape
    renderer: RayRenderer
    parameters: NDArray[np.float32]
    photograph: NDArray[np.float32]  # [3, HEIGHT, WIDTH]
    planes: Array
    rays: Rays
    cones: NDArray[np.float64]  # including padding to whole tiles

    @classmethod
    def sample(cls, device: Device, rng: np.random.Generator, rays: int, draw: RandomKey, **keys: Any) -> "FieldCase":
        """Return a case with random rays.  keys: keys of SHAPE to change, and their values."""
        shape = FieldShape.model_validate({**SHAPE.model_dump(), **keys})
        parameters = shape.initial_parameters(int(rng.integers(100)))
        for layer in shape.layers:
            parameters[layer.first_bias : layer.first_bias + layer.outputs] = rng.normal(0, 0.3, layer.outputs)
        if shape.grid:
            entries = parameters[shape.network_length : shape.network_length + shape.grid.parameter_count]
            entries[:] = rng.normal(0, 0.5, len(entries))
        scene = random_case(rng, 1, WIDTH, HEIGHT)
        camera, photograph = scene.device_camera(device), rng.random((3, HEIGHT, WIDTH)).astype(np.float32)
        field = Field(shape, device.upload(parameters), device.upload(BACKGROUND))
        renderer = field.ray_renderer
        batch = renderer.sample_rays(camera, draw, rays)
        pixels = ref.draw_pixels(WIDTH * HEIGHT, rays, draw.first, draw.seed, draw.step)
        padded_pixels = np.concatenate([pixels, np.repeat(pixels[-1:], batch.count - rays)])
        planes = to_planes(device, camera, photograph)
        cones = ref.cones(scene.camera(), padded_pixels, shape.scene_units)
        return cls(shape, renderer, parameters, photograph, planes, batch, cones)

    @property
    def device_parameters(self) -> Array:
        """The parameters in a new array on the device."""
        return self.renderer.workspace.device.upload(self.parameters)

    def uniforms(self, samples: int, stream: int) -> NDArray[np.float64]:
        """Return the random numbers for the edges of each ray, [rays, samples + 1]."""
        draw = self.rays.draw or RandomKey(0, 0, 0)
        count = self.rays.count
        rays = range(draw.first, draw.first + count)
        return np.stack([ref.uniform_numbers(ray, samples + 1, stream, draw.seed, draw.step) for ray in rays])

    def target_colors(self) -> NDArray[np.float64]:
        """Return the colors of the rays in the photograph, without padding, [rays, 3]."""
        pixels = self.rays.pixels.get()
        return self.photograph[:, pixels // WIDTH, pixels % WIDTH].T.astype(np.float64)

    def encode(self, edges: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the encoded positions and the encoded directions of samples, both [S, features]."""
        means, variances = ref.frustums(self.cones, edges.astype(np.float64))
        sines = ref.encode_frustums(means, variances, self.shape.degrees)
        direction = ref.encode_directions(self.cones, self.shape.direction_degrees)
        features = [
            grid.level.forward(grid.entries(self.parameters), *self.grid_positions(edges))
            for grid in self.grid_levels()
        ]
        position = np.concatenate([*features, sines.reshape(sines.shape[0] * sines.shape[1], sines.shape[2])], axis=1)
        return position, np.repeat(direction, edges.shape[1] - 1, axis=0)

    def grid_positions(self, edges: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the positions of samples relative to the grid's cube, [S, 3], and their variances, [S]."""
        assert self.shape.grid is not None
        means, variances = (table.reshape(-1, 3) for table in ref.frustums(self.cones, edges.astype(np.float64)))
        return ref.grid_positions(means, variances, np.array(self.shape.grid.corner), self.shape.grid.side)

    def grid_levels(self) -> list[GridLevel]:
        """Return the levels of the hash grid, or an empty list if the field has no grid."""
        table, first = self.shape.grid.table.tolist() if self.shape.grid else [], self.shape.network_length
        return [
            GridLevel(ref.HashLevel(cells, entries), first + FEATURES * offset) for cells, offset, entries, _ in table
        ]


def read_rows(table: Array, first: int, count: int) -> NDArray[Any]:
    """Return `count` features of each sample from row `first` on, [S, count].  table: [tiles, rows, SAMPLES]."""
    return np.asarray(table.get()[:, first : first + count].transpose(0, 2, 1).reshape(-1, count))


@CHECKS.add("draw_pixels", "cast_rays", "spread_edges", "resample_edges")
def cones_of_pixels(device: Device, rng: np.random.Generator) -> Results:
    """Compare pixels, rays, and the edges of samples, both random and evenly spaced."""
    for count in RAYS:
        case = FieldCase.sample(device, rng, count, RandomKey(7, 11, 5))
        pixels = ref.draw_pixels(WIDTH * HEIGHT, count, 5, 7, 11)
        yield match("draw_pixels", f"pixels of {count} rays", case.rays.pixels.get(), pixels)
        yield compare_max("cast_rays", f"cones of {count} rays", case.rays.cones.get(), case.cones, 1e-5, floor=0.1)
        for rays in (case.rays, replace(case.rays, draw=None)):
            yield from _check_edge(replace(case, rays=rays), f"{count} rays, {'drawn' if rays.draw else 'even'}")


def _check_edge(case: FieldCase, label: str) -> Results:
    coarse_edges, fine_edges = (
        (level.edges.get(), level.weights.get()) for level in case.renderer.render(case.device_parameters, case.rays)
    )
    shape, (edges, weights) = case.shape, coarse_edges
    coarse, fine = case.uniforms(shape.coarse_samples, ref.COARSE), case.uniforms(shape.fine_samples, ref.FINE)
    is_drawn = case.rays.draw is not None
    expected = [
        ref.coarse_edges(shape.near, shape.far, shape.coarse_samples, row if is_drawn else None) for row in coarse
    ]
    yield compare_max("spread_edges", f"coarse edges, {label}", edges, np.stack(expected), EDGES, floor=shape.far)
    pairs = zip(edges.astype(np.float64), weights.astype(np.float64), fine, strict=True)
    expected = [ref.fine_edges(t, w, shape.fine_samples, row if is_drawn else None) for t, w, row in pairs]
    yield compare_max("resample_edges", label, fine_edges[0], np.stack(expected), 10 * EDGES, floor=shape.far)


@CHECKS.add("encode_frustums", "encode_directions")
def encodings(device: Device, rng: np.random.Generator) -> Results:
    """Compare the encoded positions and directions, the inputs of the network."""
    for count in RAYS:
        case = FieldCase.sample(device, rng, count, RandomKey(1, 2, 0))
        level = next(case.renderer.render(case.device_parameters, case.rays))
        position, direction = case.encode(level.edges.get())
        (table, row), (direction_table, direction_row) = (
            rows(level.raw_colors.shape[0])
            for rows in (case.renderer.network.position, case.renderer.network.direction)
        )
        actual = read_rows(table, row, case.shape.position_rows)
        yield compare_max("encode_frustums", f"{count} rays", actual[:, : position.shape[1]], position, ENCODING, 1.0)
        yield match("encode_frustums", f"padding of blocks, {count} rays", actual[:, position.shape[1] :], 0.0)
        actual = read_rows(direction_table, direction_row, case.shape.direction_rows)
        yield compare_max("encode_directions", f"{count} rays", actual[:, : direction.shape[1]], direction, 2e-6, 1.0)
        yield match("encode_directions", f"padding of blocks, {count} rays", actual[:, direction.shape[1] :], 0.0)


# A grid of features: the positions of samples in the grid, their features, and the gradients of its entries.

GRID: dict[str, Any] = {
    "levels": 3,
    "coarsest": 4,
    "finest": 19,
    "entries": 512,
    "corner": [-1.0, -1.1, -1.2],
    "side": 2.5,
}
CASES: list[tuple[int, tuple[float, float], dict[str, Any]]] = [  # tiles, range of positions, keys of the grid
    *((tiles, (-0.1, 1.1), {}) for tiles in (1, 2, 17)),
    (2, (0.0, 1.0), {"levels": 1, "coarsest": 1, "finest": 1, "entries": 16}),  # a single cell, all of its corners
    (2, (-0.1, 1.1), {"entries": 16}),  # all levels use the hash
    (2, (-0.1, 1.1), {"entries": 8192}),  # no level uses the hash
    (2, (1.1, 2.0), {}),  # no sample in the cube
    (2, (0.0, 1.0), {"finest": 4096}),  # finer than most samples
]


@CHECKS.add("grid_places", "grid_forward", "grid_backward")
def grids_of_features(device: Device, rng: np.random.Generator) -> Results:
    """Compare the positions of samples in a grid, their features, and the gradients of the grid's entries."""
    for count in RAYS:
        case = FieldCase.sample(device, rng, count, RandomKey(1, 2, 0), grid=GRID)
        level = next(case.renderer.render(case.device_parameters, case.rays))
        means, variances = case.grid_positions(level.edges.get())
        actual = read_rows(case.renderer.encoding.grid_positions(level.raw_colors.shape[0]), 0, PLACE_ROWS)
        yield compare_max("grid_places", f"means of {count} rays", actual[:, :3], means, 1e-5, 1.0)
        yield compare_max("grid_places", f"variances of {count} rays", actual[:, 3], variances, 1e-3)
    for tiles, bounds, keys in CASES:
        case = FieldCase.sample(device, rng, 1, RandomKey(1, 2, 0), grid={**GRID, **keys}, degrees=2)
        yield from _check_grid(device, rng, case, _random_positions(rng, tiles, bounds))


def _random_positions(rng: np.random.Generator, tiles: int, bounds: tuple[float, float]) -> NDArray[np.float32]:
    """Return random samples of all sizes, [tiles, PLACE_ROWS, SAMPLES]; a sixth of the means are on faces of cells."""
    means = rng.uniform(*bounds, (tiles, 3, SAMPLES))
    faces = np.where(rng.random(means.shape) < 1 / 6, np.rint(4 * means) / 4, means)
    return np.concatenate([faces, 10.0 ** rng.uniform(-9, 0, (tiles, 1, SAMPLES))], axis=1).astype(np.float32)


def _flatten_samples(table: NDArray[np.float32]) -> NDArray[np.float64]:
    """Reshape [tiles, rows, SAMPLES] to [S, rows]."""
    return table.transpose(0, 2, 1).reshape(-1, table.shape[1]).astype(np.float64)


def _check_grid(device: Device, rng: np.random.Generator, case: FieldCase, positions: NDArray[np.float32]) -> Results:
    shape, encoding, tiles = case.shape, case.renderer.encoding, len(positions)
    assert shape.grid is not None
    label = (
        f"{tiles} tiles, {shape.grid.levels} levels of up to {shape.grid.finest} cells and {shape.grid.entries} entries"
    )
    encoding.grid_positions(tiles).set(positions)
    encoding.read_grid(case.device_parameters, tiles)
    table, first = case.renderer.network.position(tiles)
    features = read_rows(table, first, shape.grid_rows)
    grad_features = rng.normal(size=(tiles, shape.grid_rows, SAMPLES)).astype(np.float32)
    grad_features[:, :, ::3] = 0  # samples without a gradient
    gradients = list[NDArray[np.float32]]()
    for parts in (encoding.parts, 1, 3):
        encoding.parts, sums = parts, device.zeros(shape.table_length)
        encoding.backward(device.upload(grad_features), sums)
        gradients.append(sums.get())
    actual, *split_gradients = gradients
    for parts, gradient in zip((1, 3), split_gradients, strict=True):
        yield match("grid_backward", f"sums in {parts} parts, {label}", gradient, actual)
    sample_gradients = _flatten_samples(grad_features)
    means, variances = np.split(_flatten_samples(positions), [3], axis=1)
    variances = variances[:, 0]
    for number, grid in enumerate(case.grid_levels()):
        rows = slice(FEATURES * number, FEATURES * (number + 1))
        expected = grid.level.forward(grid.entries(case.parameters), means, variances)
        yield compare_max("grid_forward", f"level {number}, {label}", features[:, rows], expected, 5e-5, 1.0)
        expected, grad_entries = grid.level.backward(sample_gradients[:, rows], means, variances), grid.entries(actual)
        yield compare("grid_backward", f"level {number}, {label}", grad_entries, expected, Tol.GRADIENT)
        is_zero = np.all(expected == 0, axis=1)
        yield match("grid_backward", f"entries without samples, level {number}, {label}", grad_entries[is_zero], 0.0)
    yield match("grid_backward", f"parameters of the network, {label}", actual[: shape.network_length], 0.0)


# A field: its network, the colors of rays, the gradients of all parameters, images, and updates.

FIELD_CASES: list[tuple[int, dict[str, Any]]] = [
    *((count, {}) for count in RAYS),
    *((9, keys) for keys in ({"skip": None, "depth": 1}, {"degrees": 3}, {"skip": 0})),
    *((9, {"grid": GRID, **keys}) for keys in ({}, {"skip": None, "depth": 1, "degrees": 0})),
]


@CHECKS.add(
    *("dense_forward", "dense_backward", "dense_weights", "dense_biases", "dense_sums"),
    *("composite_forward", "composite_backward"),
)
def fields(device: Device, rng: np.random.Generator) -> Results:
    """Compare the colors of rays, and the gradients of all parameters through the coarse and fine samples."""
    for count, keys in FIELD_CASES:
        case = FieldCase.sample(device, rng, count, RandomKey(3, 4, 2), **keys)
        gradient = device.zeros(case.shape.table_length)
        errors, expected = device.zeros(2 + count), list[ref.Weights]()
        grad_entries = [np.zeros_like(grid.entries(case.parameters)) for grid in case.grid_levels()]
        parameters = case.device_parameters
        for scale, level in zip((0.1, 1.0), case.renderer.render(parameters, case.rays), strict=True):
            comparison = _Comparison.from_level(case, level, scale)
            yield from comparison.deviations(f"{count} rays, {level.samples} samples")
            case.renderer.differentiate(parameters, level, RayTarget(case.planes, scale, errors), gradient)
            squares = (comparison.differences[:count] ** 2).sum(axis=1)
            yield compare_max(
                "composite_backward", f"squares of {count} rays", errors.get()[2:], squares, Tol.SUM, 1e-3
            )
            grad_weights, grad_position = comparison.backward(count)
            expected.append(grad_weights)
            for number, grid in enumerate(case.grid_levels()):
                grad_features = grad_position[:, FEATURES * number : FEATURES * (number + 1)]
                grad_entries[number] += grid.level.backward(grad_features, *case.grid_positions(level.edges.get()))
        for number, (grid, truth) in enumerate(zip(case.grid_levels(), grad_entries, strict=True)):
            label = f"gradients of level {number} of the grid, {count} rays, skip {case.shape.skip}"
            for name in ("dense_backward", "grid_backward"):
                yield compare(name, label, grid.entries(gradient.get()), truth, Tol.GRADIENT)
        yield from _check_gradient(case.shape, gradient.get(), expected, f"{count} rays")


def _check_gradient(shape: FieldShape, gradient: NDArray[Any], expected: list[ref.Weights], label: str) -> Results:
    gradient = gradient[: shape.network_length]
    is_used = np.zeros(shape.network_length, bool)
    for number, (layer, (weights, biases)) in enumerate(zip(shape.layers, shape.weights(gradient), strict=True)):
        grad_weights, grad_biases = (sum(level[number][index] for level in expected) for index in (0, 1))
        kernel = "composite_backward" if layer.name in ("density", "color") else "dense_backward"
        for name in (kernel, "dense_weights", "dense_sums"):
            yield compare(name, f"weights of {layer.name}, {label}", weights, np.asarray(grad_weights), Tol.GRADIENT)
        yield compare("dense_biases", f"biases of {layer.name}, {label}", biases, np.asarray(grad_biases), Tol.GRADIENT)
        table = is_used[layer.first : layer.first_bias].reshape(layer.rows, layer.columns)
        table[np.ix_(layer.inputs, range(layer.outputs))] = True
        is_used[layer.first_bias : layer.first_bias + layer.outputs] = True
    yield match("dense_sums", f"padding of blocks, {label}", gradient[~is_used], 0.0)


@dataclass(frozen=True)
class _Comparison:
    """The reference's results for coarse or fine samples, in float64, and the results of the device."""

    level: SampleLevel
    scale: float
    network: ref.DenseNetwork
    weights: ref.Weights
    raw: tuple[NDArray[np.float64], NDArray[np.float64]]
    inputs: ref.Inputs
    composite: ref.Composite
    differences: NDArray[np.float64]

    @classmethod
    def from_level(cls, case: FieldCase, level: SampleLevel, scale: float) -> "_Comparison":
        network = ref.DenseNetwork(case.shape.depth, case.shape.skip)
        weights = case.shape.weights(case.parameters)
        edges, samples = level.edges.get().astype(np.float64), level.samples
        colors, densities, inputs = network.forward(weights, *case.encode(edges))
        lengths = np.diff(edges, axis=1) * case.cones[:, 7:8]
        composite = ref.Composite(
            colors.reshape(-1, samples, 3), densities.reshape(-1, samples), lengths, BACKGROUND.astype(np.float64)
        )
        differences = composite.colors()
        differences[: case.rays.ray_count] -= case.target_colors()
        return cls(level, scale, network, weights, (colors, densities), inputs, composite, differences)

    def deviations(self, label: str) -> Results:
        colors, densities = (
            read_rows(table, 0, count) for table, count in ((self.level.raw_colors, 3), (self.level.raw_densities, 1))
        )
        for name, actual, expected in (("colors", colors, self.raw[0]), ("densities", densities, self.raw[1])):
            yield compare_max("dense_forward", f"raw {name}, {label}", actual, expected, 1e-4, 1.0)
        weights, transmittance = self.composite.weights()
        level = self.level
        for name, table, truth in (
            ("weights", level.weights, weights),
            ("transmittance", level.transmittance, transmittance),
        ):
            yield compare_max("composite_forward", f"{name}, {label}", table.get(), truth, 1e-4, 1.0)
        yield compare_max("composite_forward", label, self.level.colors.get(), self.composite.colors(), 1e-4, 1.0)

    def backward(self, ray_count: int) -> tuple[ref.Weights, NDArray[np.float64]]:
        """Return the gradients of the weights and of the encoded positions, without the padding rays."""
        grad_colors = 2 * self.scale * self.differences
        grad_colors[ray_count:] = 0
        grad_raw, grad_densities = self.composite.backward(grad_colors)
        return self.network.backward(self.weights, self.inputs, grad_raw.reshape(-1, 3), grad_densities.reshape(-1, 1))


@CHECKS.add("place_colors")
def pictures_of_fields(device: Device, rng: np.random.Generator) -> Results:
    """Check that each pixel of an image is at the correct position, and that the padding is zero."""
    case = FieldCase.sample(device, rng, 1, RandomKey(0, 1, 0))
    field = Field(case.shape, case.device_parameters, device.upload(BACKGROUND))
    pixels = np.arange(WIDTH * HEIGHT, dtype=np.uint32)
    *_, level = case.renderer.render(
        case.device_parameters, case.renderer.cast(case.rays.camera, device.upload(pixels))
    )
    expected = np.zeros((3, case.rays.camera.rows, case.rays.camera.stride), np.float32)
    expected[:, :HEIGHT, :WIDTH] = level.colors.get()[: len(pixels)].T.reshape(3, HEIGHT, WIDTH)
    yield match("place_colors", f"an image of {WIDTH} x {HEIGHT} px", field.paint(case.rays.camera).get(), expected)


@CHECKS.add("dense_update")
def updates_of_fields(device: Device, rng: np.random.Generator) -> Results:
    """Compare three Adam updates from gradients of all magnitudes."""
    field = LearnedField.initial(SHAPE, 0, device.upload(BACKGROUND))
    count = SHAPE.table_length
    values, moment1, moment2 = SHAPE.initial_parameters(0).astype(np.float64), np.zeros(count), np.zeros(count)
    for step, epsilon in enumerate((1e-8, 1e-8, 1e-15), 1):
        gradient = (rng.normal(size=count) * 10.0 ** rng.uniform(-10, 1, count)).astype(np.float32)
        field.update(device.upload(gradient), AdamStep(0.01, epsilon), step)
        exact = gradient.astype(np.float64)
        values, moment1, moment2 = adam_step(values, exact, moment1, moment2, step, 0.01, epsilon=epsilon)
    actual = field.tables()
    yield compare_max("dense_update", "parameters", actual["parameters"][:, 0], values, 1e-4, 0.01)
    yield compare_max("dense_update", "first moments", actual["moment1"][:, 0], moment1, 1e-4, 1e-12)
    yield compare_max("dense_update", "second moments", actual["moment2"][:, 0], moment2, 1e-4, 1e-24)
