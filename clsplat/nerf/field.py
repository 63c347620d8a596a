"""Render a field at coarse and fine samples of cones, and compute gradients (Mip-NeRF, Barron et al. 2021).

Fine samples are drawn where the weights of the coarse samples are large.
"""

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
PASS_SAMPLES = 8192  # samples per pass: their features stay in a CPU's caches
RAYS = SAMPLES // LANES_MAX  # multiples of this number of rays fill whole tiles, for any number of samples per ray
assert RAYS == BLOCK


@dataclass(frozen=True)
class RandomKey:
    """The key of the random numbers for the rays of a step."""

    seed: int
    step: int
    first: int  # index of the first ray in the step


@dataclass(frozen=True)
class Rays:
    """Rays through pixels of a camera, as cones."""

    camera: DeviceCamera
    pixels: Array  # [ray_count] row * width + column
    cones: Array  # [count, RAY_VALUES]
    count: int  # including padding to whole tiles
    draw: RandomKey | None  # None for evenly spaced samples

    @property
    def ray_count(self) -> int:
        return self.pixels.shape[0]


@dataclass(frozen=True)
class SampleLevel:
    """The samples of rays in a level, and their colors; valid until the same level of other rays is rendered."""

    rays: Rays
    samples: int
    edges: Array  # [count, samples + 1] distances, in units of the field
    raw_colors: Array  # [tiles, COLOR_ROWS, SAMPLES]
    raw_densities: Array  # [tiles, COLOR_ROWS, SAMPLES]
    weights: Array  # [count, samples]
    transmittance: Array  # [count, samples] behind each sample
    colors: Array  # [count, 3]


@dataclass(frozen=True)
class RayTarget:
    """The photo that rays are compared with."""

    photograph: Array  # [3, rows, stride]
    scale: float  # factor on a ray's squared difference in the loss
    errors: Array  # [rays of the step] squared differences


class RayRenderer:
    """Renders rays level by level; each level can be differentiated until the next level is rendered."""

    def __init__(self, workspace: Workspace, shape: FieldShape, background: Array) -> None:
        """background: [3] in [0, 1]."""
        self.workspace, self.shape, self.background = workspace, shape, background
        self.network = Network(workspace, shape)
        device = workspace.device
        self.encoding = Encoding(workspace, shape, self.network)
        self._rays, self._composite = device.program("rays.cl"), device.program("composite.cl")

    def sample_rays(self, camera: DeviceCamera, draw: RandomKey, count: int) -> Rays:
        """Return `count` rays through random pixels of a camera."""
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

    def cast(self, camera: DeviceCamera, pixels: Array, draw: RandomKey | None = None) -> Rays:
        """Return the rays through pixels of a camera.  pixels: [n], row * width + column."""
        count = -(-pixels.shape[0] // RAYS) * RAYS
        cones = self.workspace.array("field cones", (count, RAY_VALUES))
        self._rays.cast_rays(
            items=count,
            pixels=pixels,
            camera=camera.array,
            cones=cones,
            scale=1 / self.shape.scene_units,
            rays=pixels.shape[0],
            count=count,
        )
        return Rays(camera, pixels, cones, count, draw)

    def render(self, parameters: Array, rays: Rays) -> Iterator[SampleLevel]:
        """Render rays: yield the coarse level, then the fine level."""
        level = self._render_level(parameters, rays, self._coarse_edges(rays), "coarse")
        yield level
        yield self._render_level(parameters, rays, self._fine_edges(level), "fine")

    def differentiate(self, parameters: Array, level: SampleLevel, target: RayTarget, gradient: Array) -> None:
        """Add the gradient of the loss of the last rendered level to `gradient`, [P].

        Also writes the squared differences between the level's rays and the target to `target.errors`.
        """
        rays, tiles = level.rays, level.raw_colors.shape[0]
        grad_colors, grad_densities = (
            self.workspace.array(f"field grad_{name}", (tiles, COLOR_ROWS, SAMPLES)) for name in ("colors", "densities")
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
            transmittance=level.transmittance,
            colors=level.colors,
            photograph=target.photograph,
            pixels=rays.pixels,
            grad_colors=grad_colors,
            grad_densities=grad_densities,
            errors=target.errors,
            scale=target.scale,
            first_ray=rays.draw.first if rays.draw else 0,
            width=camera.width,
            stride=camera.stride,
            plane=camera.rows * camera.stride,
            samples=level.samples,
            pixel_count=rays.ray_count,
            rays=rays.count,
        )
        grad_grid = self.network.backward(parameters, grad_colors, grad_densities, gradient)
        self.encoding.backward(grad_grid, gradient)

    def write_colors(self, level: SampleLevel, image: Array) -> None:
        """Write the colors of a level's rays to their pixels in an image, [3, rows, stride]."""
        camera = level.rays.camera
        self._composite.place_colors(
            items=level.rays.ray_count,
            colors=level.colors,
            pixels=level.rays.pixels,
            image=image,
            width=camera.width,
            stride=camera.stride,
            plane=camera.rows * camera.stride,
            rays=level.rays.ray_count,
        )

    def _coarse_edges(self, rays: Rays) -> Array:
        samples = self.shape.coarse_samples
        edges = self.workspace.array("field coarse edges", (rays.count, samples + 1))
        depth_range: dict[str, Any] = {"near": self.shape.near, "far": self.shape.far}
        self._rays.spread_edges(
            items=rays.count,
            edges=edges,
            samples=samples,
            count=rays.count,
            **depth_range,
            **_random_arguments(rays.draw),
        )
        return edges

    def _fine_edges(self, level: SampleLevel) -> Array:
        samples, count = self.shape.fine_samples, level.rays.count
        edges = self.workspace.array("field fine edges", (count, samples + 1))
        self._rays.resample_edges(
            items=count,
            weights=level.weights,
            edges=level.edges,
            fine=edges,
            samples=level.samples,
            fine_samples=samples,
            count=count,
            **_random_arguments(level.rays.draw),
        )
        return edges

    def _render_level(self, parameters: Array, rays: Rays, edges: Array, name: str) -> SampleLevel:
        samples = edges.shape[1] - 1
        tiles = rays.count * samples // SAMPLES
        self.encoding.forward(parameters, Samples(rays.cones, edges))
        raw_colors, raw_densities = self.network.forward(parameters, tiles)
        weights, transmittances = (
            self.workspace.array(f"field {name} {table}", (rays.count, samples))
            for table in ("weights", "transmittances")
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
            transmittance=transmittances,
            colors=colors,
            samples=samples,
            rays=rays.count,
        )
        return SampleLevel(rays, samples, edges, raw_colors, raw_densities, weights, transmittances, colors)


def rays_per_pass(shape: FieldShape) -> int:
    """Return the number of rays that are rendered in a pass."""
    return max(RAYS, PASS_SAMPLES // max(shape.coarse_samples, shape.fine_samples) // RAYS * RAYS)


def _random_arguments(draw: RandomKey | None) -> dict[str, int]:
    """Return the arguments of kernels for random or, without a key, evenly spaced sample edges."""
    key = draw or RandomKey(0, 0, 0)
    return {"drawn": int(draw is not None), "seed": key.seed, "step": key.step, "first_ray": key.first}


class Field:
    """A field on the device.  It renders views through the same interface as Gaussians (clsplat.render.painter)."""

    def __init__(self, shape: FieldShape, parameters: Array, background: Array) -> None:
        """parameters: [P], changed in place by training; background: [3] in [0, 1]."""
        self.shape, self.parameters = shape, parameters
        self.ray_renderer = RayRenderer(Workspace(parameters.device), shape, background)

    @classmethod
    def initial(cls, shape: FieldShape, seed: int, background: Array) -> "Field":
        """Return a field with the initial parameters for a seed."""
        return cls(shape, background.device.upload(shape.initial_parameters(seed)), background)

    @property
    def workspace(self) -> Workspace:
        return self.ray_renderer.workspace

    def paint(self, camera: DeviceCamera) -> Array:
        """Return the image of the fine level, [3, rows, stride], zero outside the camera's pixels."""
        image = self._empty(camera)
        for _, level in self._render_batches(camera):
            self.ray_renderer.write_colors(level, image)
        return image

    def render_layers(self, camera: DeviceCamera, depth: bool = False) -> Layers:
        """Return the image, alpha, and mean depth of the fine level on the host.

        Depths are in scene units.  The direction of a ray has depth 1, so distances along it are depths.
        """
        image, size = self._empty(camera), (camera.height, camera.width)
        alpha, depths = (np.zeros(camera.height * camera.width, np.float32) for _ in range(2))
        for pixels, level in self._render_batches(camera):
            self.ray_renderer.write_colors(level, image)
            weights, edges = (array.get()[: len(pixels)].astype(np.float64) for array in (level.weights, level.edges))
            opacity, weighted_depth = weights.sum(axis=1), (weights * (edges[:, :-1] + edges[:, 1:]) / 2).sum(axis=1)
            alpha[pixels] = np.minimum(opacity, 1)  # rounding may exceed 1
            mean_depths = np.divide(weighted_depth, opacity, out=np.zeros_like(opacity), where=opacity > 0)
            depths[pixels] = self.shape.scene_units * mean_depths
        rgb = np.ascontiguousarray(image.get()[:, : camera.height, : camera.width].transpose(1, 2, 0))
        return Layers(rgb, alpha.reshape(size), depths.reshape(size) if depth else None)

    def _empty(self, camera: DeviceCamera) -> Array:
        image = self.workspace.array("field image", (3, camera.rows, camera.stride))
        image.fill(0)
        return image

    def _render_batches(self, camera: DeviceCamera) -> Iterator[tuple[NDArray[np.uint32], SampleLevel]]:
        """Yield batches of pixels, [n], row * width + column, with their fine level, valid until the next batch."""
        pixels, count = np.arange(camera.width * camera.height, dtype=np.uint32), rays_per_pass(self.shape)
        for first in range(0, len(pixels), count):
            batch = pixels[first : first + count]
            rays = self.ray_renderer.cast(camera, self.workspace.device.upload(batch))
            *_, level = self.ray_renderer.render(self.parameters, rays)
            yield batch, level
