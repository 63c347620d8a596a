"""Cones of pixels, their samples, and the encodings of these, which a field reads."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.images import planes_of
from clsplat.conformance.comparison import Figure, by_element, equal
from clsplat.conformance.reference import cones as ref_cones
from clsplat.conformance.reference import grid as ref_grid
from clsplat.conformance.scenes import random_case
from clsplat.fields.field import Field
from clsplat.fields.grid import FEATURES
from clsplat.fields.levels import Draw, Levels, Rays
from clsplat.fields.shape import FieldShape
from clsplat.opencl.device import Array, Device

CHECKS = Checks()
RAYS = (1, 63, 64, 65)  # around a tile of samples, and a chunk of tiles
SHAPE = FieldShape(
    near=0.2,
    depth=3,
    width=16,
    skip=1,
    colour_width=12,
    degrees=5,
    direction_degrees=2,
    coarse_samples=16,
    fine_samples=32,
)
BACKGROUND = np.array([1.0, 0.7, 0.4], np.float32)
WIDTH, HEIGHT = 19, 13
ENCODING = 4e-5  # of a sine: 2^4 times a distance of about 6, rounded to 32 bits
EDGES = 2e-6  # of the distances, in shares of the farthest


@dataclass(frozen=True)
class GridLevel:
    """A level of a grid, and where its entries lie among the parameters."""

    level: ref_grid.Level
    first: int

    def of(self, parameters: NDArray[np.floating]) -> NDArray[np.float64]:
        """Its entries, [entries, FEATURES]."""
        own = parameters[self.first : self.first + FEATURES * self.level.entries]
        return own.reshape(-1, FEATURES).astype(np.float64)


@dataclass(frozen=True)
class Case:
    """Random parameters, and a camera before a random photograph."""

    shape: FieldShape
    levels: Levels
    parameters: NDArray[np.float32]
    photograph: NDArray[np.float32]  # [3, HEIGHT, WIDTH]
    planes: Array
    rays: Rays
    cones: NDArray[np.float64]  # with those that fill tiles

    @classmethod
    def of(cls, device: Device, rng: np.random.Generator, rays: int, draw: Draw, **keys: Any) -> "Case":
        """Return a case of drawn rays."""
        shape = FieldShape.model_validate({**SHAPE.model_dump(), **keys})
        parameters = shape.first_parameters(int(rng.integers(100)))
        for layer in shape.layers:
            parameters[layer.first_bias : layer.first_bias + layer.outputs] = rng.normal(0, 0.3, layer.outputs)
        if shape.grid:
            own = parameters[shape.of_network : shape.of_network + shape.grid.learned]
            own[:] = rng.normal(0, 0.5, len(own))
        scene = random_case(rng, 1, WIDTH, HEIGHT)
        camera, photograph = scene.device_camera(device), rng.random((3, HEIGHT, WIDTH)).astype(np.float32)
        field = Field(shape, device.upload(parameters), device.upload(BACKGROUND))
        cast, levels = field.levels.drawn(camera, draw, rays), field.levels
        pixels = ref_cones.drawn_pixels(WIDTH * HEIGHT, rays, draw.first, draw.seed, draw.step)
        filled = np.concatenate([pixels, np.repeat(pixels[-1:], cast.count - rays)])
        planes = planes_of(device, camera, photograph)
        return cls(shape, levels, parameters, photograph, planes, cast, ref_cones.cones(scene.camera(), filled))

    @property
    def on_device(self) -> Array:
        return self.levels.workspace.device.upload(self.parameters)

    def units(self, samples: int, kind: int) -> NDArray[np.float64]:
        """Random numbers of the edges of each ray."""
        draw = self.rays.draw or Draw(0, 0, 0)
        own = [ref_cones.units(draw.first + i, samples + 1, kind, draw.seed, draw.step) for i in range(self.rays.count)]
        return np.stack(own)

    def wanted(self) -> NDArray[np.float64]:
        """The photograph's colours of the rays that count, [counted, 3]."""
        pixels = self.rays.pixels.get()
        return self.photograph[:, pixels // WIDTH, pixels % WIDTH].T.astype(np.float64)

    def encoded(self, edges: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Encoded positions and directions of samples, [S, features]."""
        means, variances = ref_cones.frustums(self.cones, edges.astype(np.float64))
        sines = ref_cones.encoded_frustums(means, variances, self.shape.degrees)
        direction = ref_cones.encoded_directions(self.cones, self.shape.direction_degrees)
        of_grid = [own.level.forward(own.of(self.parameters), *self.places(edges)) for own in self.grid_levels()]
        position = np.concatenate([*of_grid, sines.reshape(sines.shape[0] * sines.shape[1], sines.shape[2])], axis=1)
        return position, np.repeat(direction, edges.shape[1] - 1, axis=0)

    def places(self, edges: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places of samples in the grid's cube, [S, 3], and their variances, [S]."""
        assert self.shape.grid is not None
        means, variances = (one.reshape(-1, 3) for one in ref_cones.frustums(self.cones, edges.astype(np.float64)))
        return ref_grid.places(means, variances, np.array(self.shape.grid.corner), self.shape.grid.side)

    def grid_levels(self) -> list[GridLevel]:
        """The levels of the grid; none without one."""
        table, first = self.shape.grid.table.tolist() if self.shape.grid else [], self.shape.of_network
        return [
            GridLevel(ref_grid.Level(cells, entries), first + FEATURES * before) for cells, before, entries, _ in table
        ]


def rows_of(table: Array, first: int, count: int) -> NDArray[Any]:
    """[tiles, rows, SAMPLES] -> the features `first` to `first + count` of each sample, [S, count]."""
    return np.asarray(table.get()[:, first : first + count].transpose(0, 2, 1).reshape(-1, count))


@CHECKS.add("draw_pixels", "cast_rays", "spread_edges", "resample_edges")
def cones_of_pixels(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """Pixels, rays and where they are cut, drawn and even."""
    for count in RAYS:
        case = Case.of(device, rng, count, Draw(7, 11, 5))
        pixels = ref_cones.drawn_pixels(WIDTH * HEIGHT, count, 5, 7, 11)
        yield equal("draw_pixels", f"pixels of {count} rays", case.rays.pixels.get(), pixels)
        yield by_element("cast_rays", f"{count} rays", case.rays.cones.get(), case.cones, 1e-5, floor=0.1)
        for rays in (case.rays, replace(case.rays, draw=None)):
            yield from _edge_figures(replace(case, rays=rays), f"{count} rays, {'drawn' if rays.draw else 'even'}")


def _edge_figures(case: Case, what: str) -> Iterator[Figure]:
    coarse, fine = ((level.edges.get(), level.weights.get()) for level in case.levels.render(case.on_device, case.rays))
    shape, (edges, weights) = case.shape, coarse
    drawn, again = case.units(shape.coarse_samples, ref_cones.COARSE), case.units(shape.fine_samples, ref_cones.FINE)
    is_drawn = case.rays.draw is not None
    expected = [
        ref_cones.coarse_edges(shape.near, shape.far, shape.coarse_samples, own if is_drawn else None) for own in drawn
    ]
    yield by_element("spread_edges", what, edges, np.stack(expected), EDGES, floor=shape.far)
    pairs = zip(edges.astype(np.float64), weights.astype(np.float64), again, strict=True)
    expected = [ref_cones.fine_edges(t, w, shape.fine_samples, own if is_drawn else None) for t, w, own in pairs]
    yield by_element("resample_edges", what, fine[0], np.stack(expected), 10 * EDGES, floor=shape.far)


@CHECKS.add("encode_frustums", "encode_directions")
def encodings(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    """What the network reads of a sample."""
    for count in RAYS:
        case = Case.of(device, rng, count, Draw(1, 2, 0))
        level = next(case.levels.render(case.on_device, case.rays))
        position, direction = case.encoded(level.edges.get())
        (table, first), (seen, row) = (
            place(level.raw_colours.shape[0]) for place in (case.levels.network.position, case.levels.network.seen)
        )
        found = rows_of(table, first, case.shape.position_rows)
        yield by_element("encode_frustums", f"{count} rays", found[:, : position.shape[1]], position, ENCODING, 1.0)
        yield equal("encode_frustums", f"what fills blocks, {count} rays", found[:, position.shape[1] :], 0.0)
        found = rows_of(seen, row, case.shape.direction_rows)
        yield by_element("encode_directions", f"{count} rays", found[:, : direction.shape[1]], direction, 2e-6, 1.0)
        yield equal("encode_directions", f"what fills blocks, {count} rays", found[:, direction.shape[1] :], 0.0)
