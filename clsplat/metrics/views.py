"""The metrics of a model at the views of a scene, and their means."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, NumericError
from clsplat.losses.base import Comparison
from clsplat.losses.image import ssim_maps
from clsplat.metrics.colours import colour_figures, mean_figures
from clsplat.metrics.held_out import by_moment
from clsplat.metrics.images import psnr, ssim, to_8_bits
from clsplat.metrics.perceptual import Image, Perceptual
from clsplat.metrics.stillness import Stillness, means
from clsplat.render.camera import DeviceCamera
from clsplat.render.painter import Painter
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import View
from clsplat.views.colours import OwnColours
from clsplat.views.photographs import Photograph, Photographs, unpack

LOG = logging.getLogger("clsplat")
PSNR_AND_SSIM = Perceptual()


@dataclass(frozen=True)
class ViewMetrics:
    """One view's figures."""

    view: str
    psnr: float  # dB
    ssim: float
    perceptual: dict[str, float | None] = field(default_factory=dict)
    colours: dict[str, float] = field(default_factory=dict)  # dB, by name, where photographs have colours of their own
    still: dict[str, float] = field(default_factory=dict)  # of static pixels, where the scene moves: stillness.py
    moments: dict[str, float] = field(default_factory=dict)  # dB, by whether the moment is held out: held_out.py

    def line(self) -> dict[str, Any]:
        """Return the figures as in a line of metrics.jsonl."""
        return {
            "view": self.view,
            "psnr": self.psnr,
            "ssim": self.ssim,
            **self.colours,
            **self.moments,
            **self.still,
            **self.perceptual,
        }


def render_view(painter: Painter, camera: DeviceCamera) -> Image:
    """Render to 8 bits, [height, width, 3]: clamped to [0, 1], rounded to the nearest."""
    return to_8_bits(render_floats(painter, camera))


def render_floats(painter: Painter, camera: DeviceCamera) -> NDArray[np.float32]:
    """Render to floats, [height, width, 3], as they are."""
    planes = painter.paint(camera).get()
    return np.ascontiguousarray(planes[:, : camera.height, : camera.width].transpose(1, 2, 0))


def require_finite(image: NDArray[np.float32], view: View) -> None:
    """Raise NumericError where a picture has values that are not finite."""
    if not np.isfinite(image).all():
        raise NumericError(
            f"view '{view.name}': its picture is not finite, since values of the model are too large for 32 bits; "
            "export the model again, or train it with lower rates"
        )


def device_ssim(workspace: Workspace, photograph: Photograph, image: Image) -> float:
    """Return the SSIM of an 8-bit image, [height, width, 3], and the photograph, computed on the device."""
    camera = photograph.camera
    pixels = workspace.device.upload(np.ascontiguousarray(image.transpose(2, 0, 1)))
    rendered = unpack(workspace, camera, pixels, 1 / 255, "rendered")
    planes = photograph.planes(workspace)
    _, sums = ssim_maps(Comparison(workspace, camera, rendered, planes.colours, gradient=rendered))
    return float(sums.get().sum(dtype=np.float64)) / (3 * camera.width * camera.height)


def measure(
    painter: Painter,
    views: Sequence[View],
    photographs: Photographs,
    perceptual: Perceptual = PSNR_AND_SSIM,
    finite: bool = False,
    colours: OwnColours | None = None,
    counted: Iterable[View] | None = None,
    trained: Sequence[View] = (),
) -> list[ViewMetrics]:
    """Return the metrics of every view.

    Masked pixels are black in both images; PSNR and SSIM are means over the other pixels.
    colours: the photographs' in training, for figures in their colours beside PSNR; counted: the views, of somebody who
    counts them; trained: the views that were trained on, for the figures of moments of a scene that moves.
    With `finite`, NumericError is raised for a picture that is not finite, which counts as black otherwise.
    """
    results, stillness = list[ViewMetrics](), Stillness(views)
    for view in views if counted is None else counted:
        photograph = photographs.get(view)
        if photograph.empty:
            LOG.warning("%s: not measured, since its mask leaves out every pixel; look at the mask", view.name)
            continue
        floats = render_floats(painter, photograph.camera)
        if finite:
            require_finite(floats, view)
        rendered = to_8_bits(floats)
        image, mask = photograph.image(), photograph.counted()
        own = colour_figures(floats, image, mask, colours) if colours else {}
        still = stillness.add(view, rendered, image, mask)
        if mask is None:
            similarity = device_ssim(painter.workspace, photograph, rendered)
        else:
            rendered, image = rendered * mask[..., None], image * mask[..., None]
            similarity = ssim(rendered, image, mask)
        more = perceptual.measure(rendered, image)
        results.append(ViewMetrics(view.name, psnr(rendered, image, mask), similarity, more, own, still))
    flicker, moments = stillness.figures(), by_moment({one.view: one.psnr for one in results}, views, trained)
    return [
        replace(one, still={**one.still, **flicker.get(one.view, {})}, moments=moments.get(one.view, {}))
        for one in results
    ]


def mean(results: Sequence[ViewMetrics], perceptual: Perceptual = PSNR_AND_SSIM) -> dict[str, Any]:
    """Return averages over views, with the keys of metrics.json."""
    if not results:
        raise DataError("no view can be measured: the masks leave out every pixel; fix the masks")
    return {
        "psnr": float(np.mean([r.psnr for r in results])),
        "ssim": float(np.mean([r.ssim for r in results])),
        **mean_figures([r.colours for r in results]),
        **means([r.moments for r in results]),
        **means([r.still for r in results]),
        **perceptual.mean([r.perceptual for r in results]),
        "views": len(results),
    }
