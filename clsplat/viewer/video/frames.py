"""Render the layers of views, and convert them to 8-bit images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.metrics.images import to_8_bits
from clsplat.metrics.views import require_finite
from clsplat.render.camera import upload_camera
from clsplat.render.painter import Layers, Painter
from clsplat.scene.view import View

Image = NDArray[np.uint8]
LAYERS = ("color", "depth", "alpha")
PROBES = 8  # views whose depths determine the range of colors
PROBE_SIDE = 240  # px
OPAQUE = 0.5  # alpha above which the depth of a pixel counts
QUANTILES = 0.02, 0.98  # of the depths, for near and far
MIN_RANGE = 1e-3  # relative to far


@dataclass(frozen=True)
class Canvas:
    """Renders the views of a model."""

    painter: Painter

    def render_layers(self, view: View, depth: bool = False) -> Layers:
        """Render the color, alpha, and optionally depth of a view.  Raises NumericError if they are not finite."""
        layers = self.painter.render_layers(upload_camera(self.painter.workspace.device, view), depth)
        for values in layers.arrays:
            require_finite(values, view)
        return layers

    def picture(self, view: View) -> Image:
        """Render a view as 8-bit RGB, [height, width, 3]."""
        return to_8_bits(self.render_layers(view).image)

    def depth_range(self, views: Sequence[View]) -> tuple[float, float]:
        """Return near and far, scene units: quantiles of the depths in a sample of views, or 1 and 2 without depths."""
        depths = []
        for i in np.unique(np.linspace(0, len(views) - 1, min(PROBES, len(views))).round().astype(int)):
            view, long_side = views[i], max(views[i].camera.width, views[i].camera.height)
            small_view = replace(view, camera=view.camera.downscaled(max(1, long_side / PROBE_SIDE)))
            layers = self.render_layers(small_view, depth=True)
            assert layers.depth is not None
            depths.append(layers.depth[layers.alpha > OPAQUE])
        all_depths = np.concatenate(depths)
        if not len(all_depths):
            return 1.0, 2.0
        near, far = np.quantile(all_depths, QUANTILES)
        return float(min(near, far * (1 - MIN_RANGE))), float(far)


def layer_image(layers: Layers, layer: str, depths: tuple[float, float]) -> Image:
    """Return a layer, named in LAYERS, as 8-bit RGB, [height, width, 3].  depths: near and far, scene units."""
    if layer == "color":
        return to_8_bits(layers.image)
    if layer == "alpha":
        return np.repeat(to_8_bits(layers.alpha)[:, :, None], 3, axis=2)
    assert layers.depth is not None
    return depth_image(layers.depth, layers.alpha, depths)


def layer_values(layers: Layers, layer: str) -> NDArray[np.float32]:
    """Return a layer, named in LAYERS, as floats, [height, width] or [height, width, 3]."""
    array = {"color": layers.image, "depth": layers.depth, "alpha": layers.alpha}[layer]
    assert array is not None
    return array


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
