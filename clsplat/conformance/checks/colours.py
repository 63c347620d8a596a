"""The colours of a photograph: a change of an image and its derivatives."""

from collections.abc import Iterator

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.images import SIZES, camera_of, outside, planes_of
from clsplat.conformance.comparison import SUM, Figure, by_element, equal
from clsplat.opencl.device import Device
from clsplat.render.workspace import Workspace
from clsplat.views.colours import IDENTITY
from clsplat.views.photograph_colours import change_back, change_colours

CHECKS = Checks()
MARGIN = 1e-3  # from white, where the cut is a decision


def colour_figures(
    device: Device, rng: np.random.Generator, width: int, height: int, channels: int = 3
) -> Iterator[Figure]:
    """Compare an image with a third of its pixels beyond white, its gradient, and that by the matrix."""
    what = f"{width} x {height} px"
    matrix = (IDENTITY + rng.normal(0, 0.2, (3, 4))).astype(np.float32).astype(np.float64)
    image = rng.uniform(-0.2, 1.6, (channels, height, width)).astype(np.float32)
    near = np.abs(np.einsum("ab,bhw->ahw", matrix[:, :3], image[:3]) + matrix[:, 3, None, None] - 1).min(axis=0)
    image[:, near < MARGIN] = 0
    gradient = rng.normal(size=image.shape).astype(np.float32)
    camera, workspace = camera_of(device, width, height), Workspace(device)
    for name in ("coloured", "grad_coloured"):
        workspace.array(name, (channels, camera.rows, camera.stride)).fill(np.nan)
    planes = planes_of(device, camera, image)
    found = change_colours(workspace, camera, planes, matrix).get()
    exact = image[:3].astype(np.float64)
    expected = ref.coloured(exact, matrix)
    yield by_element("colours_forward", f"colours, {what}", found[:3, :height, :width], expected, 2e-6, floor=1.0)
    yield equal("colours_forward", f"pixels outside the image, {what}", outside(camera, found), 0.0)
    uploaded = planes_of(device, camera, gradient)
    grad_image, waiting = change_back(workspace, camera, planes, matrix, uploaded)
    by_image, by_matrix = ref.coloured_backward(exact, matrix, gradient[:3].astype(np.float64))
    passed = grad_image.get()
    yield by_element("colours_backward", f"gradient, {what}", passed[:3, :height, :width], by_image, 2e-6, floor=1.0)
    yield equal("colours_backward", f"gradient outside the image, {what}", outside(camera, passed), 0.0)
    size = float(np.sqrt(gradient.size))
    yield by_element("colours_backward", f"gradient by the matrix, {what}", waiting(), by_matrix, SUM, floor=size)
    if channels > 3:
        yield equal("colours_forward", f"fourth plane, {what}", found[3], planes.get()[3])
        yield equal("colours_backward", f"gradient of the fourth plane, {what}", passed[3], uploaded.get()[3])


@CHECKS.add("colours_forward", "colours_backward")
def colours(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for width, height in SIZES:
        yield from colour_figures(device, rng, width, height)
    yield from colour_figures(device, rng, 33, 18, channels=4)
