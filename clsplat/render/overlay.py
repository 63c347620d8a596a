"""Composite a separate layer of splats over an image, and compute the gradients of both."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from clsplat.opencl.device import Array
from clsplat.render.rasterizer import Frame
from clsplat.render.workspace import Workspace


@dataclass(frozen=True)
class OverlayLayer:
    """A layer composited over an image; valid until the next call of `composite_layer`."""

    frame: Frame  # the layer alone, rendered over black
    image: Array  # composite, [3 or 4, rows, stride]
    transmittance_gradient: Array  # T dL/dT of the loss on the layer's alpha, [1, rows, stride]
    loss: Callable[[], float]  # returns the value of that loss; waits for the device


def composite_layer(workspace: Workspace, frame: Frame, image: Array, scale: float) -> OverlayLayer:
    """Composite a layer, rendered over black, onto an image, [3 or 4, rows, stride].

    scale: weight of the loss on the layer's alpha, the sum of 1 - T over pixels.
    """
    camera = frame.camera
    composite, sums = workspace.array("image and layer", image.shape), workspace.array("layer sums", camera.rows)
    behind = workspace.array("behind a layer", (1, camera.rows, camera.stride))
    workspace.device.program("layer.cl").lay_over(
        groups=(1, camera.rows),
        layer=frame.image,
        transmittance=frame.transmittance,
        image=image,
        composite=composite,
        behind=behind,
        row_sums=sums,
        scale=scale,
        channels=image.shape[0],
        **camera.plane_arguments(),
    )
    return OverlayLayer(frame, composite, behind, lambda: scale * float(np.asarray(sums.get()).sum(dtype=np.float64)))


def backpropagate_composite(workspace: Workspace, frame: Frame, gradient: Array) -> None:
    """Convert the gradient of the composite, [3 or 4, rows, stride], to that of the image under the layer, in place."""
    camera = frame.camera
    workspace.device.program("layer.cl").look_behind(
        groups=(1, camera.rows),
        transmittance=frame.transmittance,
        gradient=gradient,
        rows=camera.rows,
        stride=camera.stride,
    )
