"""Image metrics as papers quote them: of 8-bit images, PSNR over all channels, SSIM with an 11 x 11 Gaussian window."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from clsplat.gaussians.tables import DeviceModel
from clsplat.losses.image import Comparison, ssim_maps
from clsplat.metrics.perceptual import Image, Perceptual, ssim_map
from clsplat.opencl.device import Array
from clsplat.render.rasterizer import DeviceCamera, Rasterizer
from clsplat.scene.scene import View
from clsplat.views.photographs import Mask, Photograph, Photographs, unpack

PSNR_CAP = 100.0  # dB, for equal images
PSNR_AND_SSIM = Perceptual()


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


def render_view(rasterizer: Rasterizer, model: DeviceModel, camera: DeviceCamera, background: Array) -> Image:
    """Render to 8 bits, [height, width, 3]: clamped to [0, 1], rounded to the nearest.  background: [3]."""
    frame = rasterizer.forward(model, camera, background)
    image = frame.image.get()[:, : camera.height, : camera.width]
    return np.ascontiguousarray((np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8).transpose(1, 2, 0))


def psnr(image: Image, truth: Image, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio in dB of two 8-bit images, over the pixels that count."""
    squared = (image.astype(np.float64) - truth) ** 2
    error = float(np.mean(squared if mask is None else squared[mask])) / 255**2
    return PSNR_CAP if error == 0 else 10 * math.log10(1 / error)


def ssim(rasterizer: Rasterizer, target: Photograph, image: Image) -> float:
    """Structural similarity of an 8-bit image, [height, width, 3], and the photograph."""
    workspace, camera = rasterizer.workspace, target.camera
    pixels = rasterizer.device.upload(np.ascontiguousarray(image.transpose(2, 0, 1)))
    planes = unpack(workspace, camera, pixels, "rendered")
    truth = unpack(workspace, camera, target.pixels)
    comparison = Comparison(workspace, camera, planes, truth, gradient=planes)
    _, sums = ssim_maps(comparison)
    return float(sums.get().sum(dtype=np.float64)) / comparison.values


def measure(
    rasterizer: Rasterizer,
    model: DeviceModel,
    views: Sequence[View],
    targets: Photographs,
    perceptual: Perceptual = PSNR_AND_SSIM,
) -> list[ViewMetrics]:
    """Return the metrics of every view.

    What a mask leaves out is black in both images, and PSNR and SSIM are means over the other pixels.
    """
    results = []
    for view in views:
        target = targets.get(view)
        image = render_view(rasterizer, model, target.camera, targets.background_array)
        truth, mask = target.image(), target.mask()
        if mask is None:
            similarity = ssim(rasterizer, target, image)
        else:
            image, truth = image * mask[..., None], truth * mask[..., None]
            similarity = float(ssim_map(image, truth)[mask].mean())
        more = perceptual.measure(image, truth)
        results.append(ViewMetrics(view.name, psnr(image, truth, mask), similarity, more))
    return results


def mean(results: Sequence[ViewMetrics], perceptual: Perceptual = PSNR_AND_SSIM) -> dict[str, Any]:
    """Averages over views, with the keys of metrics.json."""
    return {
        "psnr": float(np.mean([r.psnr for r in results])),
        "ssim": float(np.mean([r.ssim for r in results])),
        **perceptual.mean([r.perceptual for r in results]),
        "views": len(results),
    }
