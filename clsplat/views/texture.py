"""The texture of images: their gradient magnitude, |Sobel| / 8 of the luminance, per px."""

from collections.abc import Iterable

import numpy as np

from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.views.photographs import Photograph

MAX_MAGNITUDE = 0.75  # per px: above the largest possible magnitude
BINS = 3000


def image_gradient(workspace: Workspace, camera: DeviceCamera, image: Array, name: str = "texture") -> Array:
    """Return the gradient magnitudes, [rows, stride] per px, of an image [3, rows, stride] in [0, 1]."""
    magnitude = workspace.array(name, (camera.rows, camera.stride))
    device = workspace.device
    device.program("texture.cl").image_gradient(
        items=(-(-camera.stride // int(device.tuning["LANES"])), camera.rows),
        image=image,
        magnitude=magnitude,
        **camera.plane_arguments(),
    )
    return magnitude


def known_gradient(workspace: Workspace, camera: DeviceCamera, image: Array, mask: Array | None) -> Array:
    """Return gradient magnitudes, but -1 at pixels that the mask, [1, rows, stride], leaves out, and beside them."""
    magnitude = image_gradient(workspace, camera, image)
    if mask is not None:
        workspace.device.program("texture.cl").hide_masked(
            items=(camera.width, camera.height),
            mask=mask,
            magnitude=magnitude,
            width=camera.width,
            height=camera.height,
            stride=camera.stride,
        )
    return magnitude


def texture_quantile(workspace: Workspace, photographs: Iterable[Photograph], share: float) -> float:
    """Return the magnitude, per px, to 1 / 4000, that `share` of all pixels that count stay below."""
    counts = np.zeros(BINS, np.int64)
    for photograph in photographs:
        camera, planes = photograph.camera, photograph.planes(workspace)
        inside = known_gradient(workspace, camera, planes.colours, planes.mask).get()[: camera.height, : camera.width]
        counts += np.histogram(inside, BINS, (0, MAX_MAGNITUDE))[0]  # without values below 0
    below = np.searchsorted(np.cumsum(counts), share * counts.sum())
    return float(below + 1) * MAX_MAGNITUDE / BINS
