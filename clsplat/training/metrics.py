"""Image metrics as papers quote them: of 8-bit images, PSNR over all channels, SSIM with an 11 x 11 Gaussian window."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from clsplat.gaussians.model import Model
from clsplat.opencl.device import Array
from clsplat.render.renderer import DeviceCamera, Renderer
from clsplat.scene.scene import View
from clsplat.training.losses import Comparison, ssim_maps
from clsplat.training.perceptual import Image, Perceptual, ssim_map
from clsplat.training.targets import Mask, Target, Targets, unpack

PSNR_CAP = 100.0  # dB, for equal images
NOTHING_MORE = Perceptual()


@dataclass(frozen=True)
class ViewMetrics:
    """One view's figures."""

    view: str
    psnr: float  # dB
    ssim: float
    perceptual: dict[str, float | None] = field(default_factory=dict)

    def line(self) -> dict[str, Any]:
        """The figures as a line of metrics.jsonl has them."""
        return {"view": self.view, "psnr": self.psnr, "ssim": self.ssim, **self.perceptual}


def render_view(renderer: Renderer, model: Model, camera: DeviceCamera, background: Array) -> Image:
    """Render to 8 bits, [height, width, 3]: clamped to [0, 1], rounded to the nearest.  background: [3]."""
    frame = renderer.forward(model, camera, background)
    image = frame.image.get()[:, : camera.height, : camera.width]
    return np.ascontiguousarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8).transpose(1, 2, 0))


def psnr(image: Image, truth: Image, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two 8-bit images, over the pixels that count."""
    squared = (image.astype(np.float64) - truth) ** 2
    error = float(np.mean(squared if mask is None else squared[mask])) / 255**2
    return PSNR_CAP if error == 0 else 10 * math.log10(1 / error)


def ssim(renderer: Renderer, target: Target, image: Image) -> float:
    """Structural similarity of an 8-bit image, [height, width, 3], and the photograph."""
    workspace, camera = renderer.workspace, target.camera
    pixels = renderer.device.upload(np.ascontiguousarray(image.transpose(2, 0, 1)))
    planes = unpack(workspace, camera, pixels, "rendered")
    truth = unpack(workspace, camera, target.pixels)
    comparison = Comparison(workspace, camera, planes, truth, gradient=planes)
    _, sums = ssim_maps(comparison)
    return float(sums.get().sum(dtype=np.float64)) / comparison.values


def measure(
    renderer: Renderer, model: Model, views: Sequence[View], targets: Targets, perceptual: Perceptual = NOTHING_MORE
) -> list[ViewMetrics]:
    """Return the metrics of every view.

    What a mask leaves out is black in both images, and PSNR and SSIM are means over the other pixels.
    """
    results = []
    for view in views:
        target = targets.get(view)
        image = render_view(renderer, model, target.camera, targets.background_array)
        truth, mask = target.image(), target.mask()
        if mask is None:
            similarity = ssim(renderer, target, image)
        else:
            image, truth = image * mask[..., None], truth * mask[..., None]
            similarity = float(ssim_map(image, truth)[mask].mean())
        more = perceptual.measure(image, truth)
        results.append(ViewMetrics(view.name, psnr(image, truth, mask), similarity, more))
    return results


def mean(results: Sequence[ViewMetrics], perceptual: Perceptual = NOTHING_MORE) -> dict[str, Any]:
    """Averages over views, with the keys of metrics.json."""
    return {
        "psnr": float(np.mean([r.psnr for r in results])),
        "ssim": float(np.mean([r.ssim for r in results])),
        **perceptual.mean([r.perceptual for r in results]),
        "views": len(results),
    }
