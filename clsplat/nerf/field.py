"""The two levels of a field: coarse samples of cones, fine ones where the coarse weights are, and their gradients
(Barron et al. 2021)."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.nerf.network import Encoding, Network, Samples
from clsplat.nerf.shape import BLOCK, COLOR_ROWS, LANES_MAX, SAMPLES, FieldShape
from clsplat.opencl.device import Array, constants
from clsplat.render.camera import DeviceCamera
from clsplat.render.painter import Layers
from clsplat.render.workspace import Workspace

RAY_VALUES = int(constants("rays.cl")["RAY_VALUES"])
PASS_SAMPLES = 8192  # that are computed at a time: their features stay in the caches of a CPU
RAYS = SAMPLES // LANES_MAX  # a multiple of it fills tiles, whatever the samples of a ray
assert RAYS == BLOCK


@dataclass(frozen=True)
class Draw:
    """Random numbers of rays of a step; without one, samples are even."""

    seed: int
    step: int
    first: int  # ray of the step


@dataclass(frozen=True)
class Rays:
    """Pixels of a camera with their cones."""

    camera: DeviceCamera
    pixels: Array  # [counted] row * width + column
    cones: Array  # [count, RAY_VALUES]
    count: int  # with those that fill tiles
    draw: Draw | None

    @property
    def counted(self) -> int:
        return self.pixels.shape[0]


@dataclass(frozen=True)
class SampleLevel:
    """The samples of rays in one level, and what they give; valid until the same level of other rays."""

    rays: Rays
    samples: int
    edges: Array  # [count, samples + 1]
    raw_colors: Array  # [tiles, COLOR_ROWS, SAMPLES]
    raw_densities: Array  # [tiles, COLOR_ROWS, SAMPLES]
    weights: Array  # [count, samples]
    left: Array  # [count, samples]
    colors: Array  # [count, 3]


@dataclass(frozen=True)
class RayTarget:
    """What the colors of rays are compared with."""

    photograph: Array  # [3, rows, stride]
    scale: float  # of a ray's squared difference in the loss
    errors: Array  # [rays of the step], squared differences


class Levels:
    """Renders rays of a field, level by level; each level can be differentiated until the next is rendered."""

    def __init__(self, workspace: Workspace, shape: FieldShape, background: Array) -> None:
        """background: [3] in [0, 1]."""
        self.workspace, self.shape, self.background = workspace, shape, background
        self.network = Network(workspace, shape)
        device = workspace.device
        self.encoding = Encoding(workspace, shape, self.network)
        self._rays, self._composite = device.program("rays.cl"), device.program("composite.cl")

    @property
    def rays_at_a_time(self) -> int:
        """Rays of one pass."""
        return rays_at_a_time(self.shape)

    def drawn(self, camera: DeviceCamera, draw: Draw, count: int) -> Rays:
        """Return rays of random pixels."""
        pixels = self.workspace.array("field pixels", count, np.uint32)
        pixel_count = camera.width * camera.height
        self._rays.draw_pixels(
            items=count,
            pixels=pixels,
            pixel_count=pixel_count,
            first_ray=draw.first,
            seed=draw.seed,
            step=draw.step,
            rays=count,
        )
        return self.cast(camera, pixels, draw)

    def cast(self, camera: DeviceCamera, pixels: Array, draw: Draw | None = None) -> Rays:
        """Return the rays of pixels, [n] of row * width + column."""
        count = -(-pixels.shape[0] // RAYS) * RAYS
        cones = self.workspace.array("field cones", (count, RAY_VALUES))
        self._rays.cast_rays(
            items=count, pixels=pixels, camera=camera.array, cones=cones, rays=pixels.shape[0], count=count
        )
        return Rays(camera, pixels, cones, count, draw)

    def render(self, parameters: Array, rays: Rays) -> Iterator[SampleLevel]:
        """Yield the coarse level, then the fine one."""
        coarse = self._level(parameters, rays, self._coarse_edges(rays), "coarse")
        yield coarse
        yield self._level(parameters, rays, self._fine_edges(coarse), "fine")

    def differentiate(self, parameters: Array, level: SampleLevel, target: RayTarget, gradient: Array) -> None:
        """Add the derivatives of the loss of a level, the last one that was rendered, to `gradient`, [P]; write the
        squared differences of its rays."""
        rays, tiles = level.rays, level.raw_colors.shape[0]
        by_colors, by_densities = (
            self.workspace.array(f"field by {name}", (tiles, COLOR_ROWS, SAMPLES)) for name in ("colors", "densities")
        )
        camera = rays.camera
        self._composite.composite_backward(
            items=rays.count,
            raw_colors=level.raw_colors,
            raw_densities=level.raw_densities,
            cones=rays.cones,
            edges=level.edges,
            background=self.background,
            weights=level.weights,
            left=level.left,
            colors=level.colors,
            photograph=target.photograph,
            pixels=rays.pixels,
            by_colors=by_colors,
            by_densities=by_densities,
            errors=target.errors,
            scale=target.scale,
            first_ray=rays.draw.first if rays.draw else 0,
            width=camera.width,
            stride=camera.stride,
            plane=camera.rows * camera.stride,
            samples=level.samples,
            counted=rays.counted,
            rays=rays.count,
        )
        by_grid = self.network.backward(parameters, by_colors, by_densities, gradient)
        self.encoding.backward(by_grid, gradient)

    def place(self, level: SampleLevel, image: Array) -> None:
        """Put the colors of a level's rays into a picture, [3, rows, stride]."""
        camera = level.rays.camera
        self._composite.place_colors(
            items=level.rays.counted,
            colors=level.colors,
            pixels=level.rays.pixels,
            image=image,
            width=camera.width,
            stride=camera.stride,
            plane=camera.rows * camera.stride,
            rays=level.rays.counted,
        )

    def _coarse_edges(self, rays: Rays) -> Array:
        samples = self.shape.coarse_samples
        edges = self.workspace.array("field coarse edges", (rays.count, samples + 1))
        own: dict[str, Any] = {"samples": samples, "near": self.shape.near, "far": self.shape.far, **_random(rays.draw)}
        self._rays.spread_edges(items=rays.count, edges=edges, count=rays.count, **own)
        return edges

    def _fine_edges(self, coarse: SampleLevel) -> Array:
        samples, count = self.shape.fine_samples, coarse.rays.count
        edges = self.workspace.array("field fine edges", (count, samples + 1))
        own = {"samples": coarse.samples, "fine_samples": samples, **_random(coarse.rays.draw)}
        self._rays.resample_edges(
            items=count, weights=coarse.weights, edges=coarse.edges, fine=edges, count=count, **own
        )
        return edges

    def _level(self, parameters: Array, rays: Rays, edges: Array, name: str) -> SampleLevel:
        samples = edges.shape[1] - 1
        tiles = rays.count * samples // SAMPLES
        self.encoding.forward(parameters, Samples(rays.cones, edges))
        raw_colors, raw_densities = self.network.forward(parameters, tiles)
        weights, left = (
            self.workspace.array(f"field {name} {what}", (rays.count, samples)) for what in ("weights", "left")
        )
        colors = self.workspace.array(f"field {name} rays", (rays.count, 3))
        self._composite.composite_forward(
            items=rays.count,
            raw_colors=raw_colors,
            raw_densities=raw_densities,
            cones=rays.cones,
            edges=edges,
            background=self.background,
            weights=weights,
            left=left,
            colors=colors,
            samples=samples,
            rays=rays.count,
        )
        return SampleLevel(rays, samples, edges, raw_colors, raw_densities, weights, left, colors)


def rays_at_a_time(shape: FieldShape) -> int:
    """Return the rays of one pass."""
    return max(RAYS, PASS_SAMPLES // max(shape.coarse_samples, shape.fine_samples) // RAYS * RAYS)


def _random(draw: Draw | None) -> dict[str, int]:
    """The arguments of kernels that draw edges."""
    own = draw or Draw(0, 0, 0)
    return {"drawn": int(draw is not None), "seed": own.seed, "step": own.step, "first_ray": own.first}


# A field on the device: the parameters of its network, and its pictures.


class Field:
    """The parameters of a shape; paints views as Gaussians do (clsplat.render.painter)."""

    def __init__(self, shape: FieldShape, parameters: Array, background: Array) -> None:
        """parameters: [P], changed in place by training; background: [3] in [0, 1]."""
        self.shape, self.parameters = shape, parameters
        self.levels = Levels(Workspace(parameters.device), shape, background)

    @classmethod
    def first(cls, shape: FieldShape, seed: int, background: Array) -> "Field":
        """Return a field with the first parameters of a seed."""
        return cls(shape, background.device.upload(shape.first_parameters(seed)), background)

    @property
    def workspace(self) -> Workspace:
        return self.levels.workspace

    def paint(self, camera: DeviceCamera) -> Array:
        """Return the picture of the fine level, [3, rows, stride], zero outside the camera's pixels."""
        image = self._empty(camera)
        for _, fine in self._passes(camera):
            self.levels.place(fine, image)
        return image

    def layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        """Return the picture of the fine level on the host, what its samples cover, and their mean depth.

        A ray has depth 1 in the camera where its distance is 1, so that distances are depths, in scene units.
        """
        image, size = self._empty(camera), (camera.height, camera.width)
        alpha, depths = (np.zeros(camera.height * camera.width, np.float32) for _ in range(2))
        for pixels, fine in self._passes(camera):
            self.levels.place(fine, image)
            weights, edges = (array.get()[: len(pixels)].astype(np.float64) for array in (fine.weights, fine.edges))
            covered, summed = weights.sum(axis=1), (weights * (edges[:, :-1] + edges[:, 1:]) / 2).sum(axis=1)
            alpha[pixels] = np.minimum(covered, 1)  # a sum of rounded weights
            depths[pixels] = np.divide(summed, covered, out=np.zeros_like(covered), where=covered > 0)
        shown = np.ascontiguousarray(image.get()[:, : camera.height, : camera.width].transpose(1, 2, 0))
        return Layers(shown, alpha.reshape(size), depths.reshape(size) if depth else None)

    def _empty(self, camera: DeviceCamera) -> Array:
        image = self.workspace.array("field picture", (3, camera.rows, camera.stride))
        image.fill(0)
        return image

    def _passes(self, camera: DeviceCamera) -> Iterator[tuple[NDArray[np.uint32], SampleLevel]]:
        """Pixels, [n] of row * width + column, and their fine level, valid until the next."""
        pixels, at_a_time = np.arange(camera.width * camera.height, dtype=np.uint32), self.levels.rays_at_a_time
        for first in range(0, len(pixels), at_a_time):
            own = pixels[first : first + at_a_time]
            rays = self.levels.cast(camera, self.workspace.device.upload(own))
            *_, fine = self.levels.render(self.parameters, rays)
            yield own, fine
