"""Render the layers of views, and convert them to 8-bit images."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError
from clsplat.metrics.images import to_8_bits
from clsplat.metrics.views import require_finite
from clsplat.render.camera import upload_camera
from clsplat.render.painter import Layers, Painter
from clsplat.scene.view import View

Image = NDArray[np.uint8]
LAYERS = ("color", "depth", "median_depth", "normals", "alpha")
DEPTH_LAYERS = frozenset(LAYERS[1:4])  # need depths
PROBES = 8  # views whose depths determine the range of colors
PROBE_SIDE = 240  # px
OPAQUE = 0.5  # alpha above which the depth of a pixel counts
QUANTILES = 0.02, 0.98  # of the depths, for near and far
MIN_RANGE = 1e-3  # smallest difference between near and far, relative to far
MAX_STEP = 0.05  # largest relative difference between neighboring depths; normals are unknown at larger steps


@dataclass(frozen=True)
class Canvas:
    """Renders the views of a model."""

    painter: Painter

    def render_layers(self, view: View, names: Collection[str] = LAYERS[:1]) -> Layers:
        """Render the color, the alpha, and the named layers of a view.  Raises NumericError for non-finite values."""
        has_depth = not DEPTH_LAYERS.isdisjoint(names)
        layers = self.painter.render_layers(upload_camera(self.painter.workspace.device, view), has_depth)
        for values in layers.arrays:
            require_finite(values, view)
        if "normals" in names:
            assert layers.depth is not None
            return replace(layers, normals=depth_normals(layers.depth, view))
        return layers

    def render_image(self, view: View) -> Image:
        """Render a view as 8-bit RGB, [height, width, 3]."""
        return to_8_bits(self.render_layers(view).image)

    def depth_range(self, views: Sequence[View]) -> tuple[float, float]:
        """Return the near and far depths, scene units, which are quantiles of the depths in a sample of views.

        Returns 1 and 2 if nothing in these views is opaque.
        """
        depths = []
        for i in np.unique(np.linspace(0, len(views) - 1, min(PROBES, len(views))).round().astype(int)):
            view, long_side = views[i], max(views[i].camera.width, views[i].camera.height)
            small_view = replace(view, camera=view.camera.downscaled(max(1, long_side / PROBE_SIDE)))
            layers = self.render_layers(small_view, DEPTH_LAYERS)
            assert layers.depth is not None
            depths.append(layers.depth[layers.alpha > OPAQUE])
        all_depths = np.concatenate(depths)
        if not len(all_depths):
            return 1.0, 2.0
        near, far = np.quantile(all_depths, QUANTILES)
        return float(min(near, far * (1 - MIN_RANGE))), float(far)


def layer_image(layers: Layers, layer: str, depths: tuple[float, float]) -> Image:
    """Return a layer, one of LAYERS, as 8-bit RGB, [height, width, 3].  depths: near and far, scene units."""
    if layer == "color":
        return to_8_bits(layers.image)
    if layer == "alpha":
        return np.repeat(to_8_bits(layers.alpha)[:, :, None], 3, axis=2)
    values = layer_values(layers, layer)
    if layer == "normals":
        return to_8_bits(((values + 1) / 2 * (values != 0).any(axis=2, keepdims=True)).astype(np.float32))
    return depth_image(values, layers.alpha, depths)


def layer_values(layers: Layers, layer: str) -> NDArray[np.float32]:
    """Return a layer, one of LAYERS, as floats, [height, width] or [height, width, 3].

    Raises ConfigError for the median depth of a field, because fields have only a mean depth.
    """
    array = {"color": layers.image}.get(layer, getattr(layers, layer, None))
    if array is None:
        raise ConfigError(f"--depth median: a field has no {layer.replace('_', ' ')}; use --depth mean")
    return array


def depth_normals(depth: NDArray[np.float32], view: View) -> NDArray[np.float32]:
    """Return the unit normals of a depth image, in the axes of the scene, toward the camera, [height, width, 3].

    The normal of a pixel is computed from the points at its left and right neighbors and at its upper and lower
    neighbors.  It is 0 where a neighbor has no depth, or a depth that differs by more than MAX_STEP.
    """
    camera, (height, width) = view.camera, depth.shape
    x = (np.arange(width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(height) + 0.5 - camera.cy) / camera.fy
    z = np.pad(depth.astype(np.float64), 1)
    points = np.stack([z[1:-1, 1:-1] * x, z[1:-1, 1:-1] * y[:, None], z[1:-1, 1:-1]], axis=2)
    is_valid = depth > 0
    for neighbor in (z[1:-1, :-2], z[1:-1, 2:], z[:-2, 1:-1], z[2:, 1:-1]):
        is_valid = is_valid & (np.abs(neighbor - depth) <= MAX_STEP * depth)
    padded = np.pad(points, ((1, 1), (1, 1), (0, 0)))
    normals = np.cross(padded[2:, 1:-1] - padded[:-2, 1:-1], padded[1:-1, 2:] - padded[1:-1, :-2])
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    unit_normals = np.divide(normals, length, out=np.zeros_like(normals), where=is_valid[:, :, None] & (length > 0))
    return np.asarray(unit_normals @ view.world_to_camera[:, :3], np.float32)


def depth_image(depth: NDArray[np.float32], alpha: NDArray[np.float32], depths: tuple[float, float]) -> Image:
    """Return depths, [height, width], as colors from red (near) to blue (far), and black where alpha is 0.

    Colors are linear in inverse depth, because differences between small depths are more visible.
    """
    near, far = depths
    with np.errstate(divide="ignore"):
        level = (1 / np.maximum(depth, 1e-30) - 1 / far) / (1 / near - 1 / far)
    colors = cv2.applyColorMap(to_8_bits(level.astype(np.float32)), cv2.COLORMAP_TURBO)[:, :, ::-1]
    coverage = np.where(depth > 0, alpha, 0)[:, :, None]
    return to_8_bits((colors / np.float32(255) * coverage).astype(np.float32))


def side_by_side(left: Image, right: Image) -> Image:
    """Join two images of the same height side by side."""
    return np.hstack([left, right])


def letterbox(image: Image, size: tuple[int, int]) -> Image:
    """Scale an image to fit a size (width, height), and center it on a black background."""
    width, height = size
    factor = min(width / image.shape[1], height / image.shape[0])
    inner = max(1, min(width, round(image.shape[1] * factor))), max(1, min(height, round(image.shape[0] * factor)))
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    box = np.zeros((height, width, 3), np.uint8)
    left, top = (width - inner[0]) // 2, (height - inner[1]) // 2
    box[top : top + inner[1], left : left + inner[0]] = cv2.resize(image, inner, interpolation=interpolation)
    return box
