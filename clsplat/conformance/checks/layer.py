"""A layer of splats before an image."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.images import SIZES, camera_of, outside, planes_of
from clsplat.conformance.comparison import SUM, Figure, by_element, equal
from clsplat.opencl.device import Device
from clsplat.render.layer import lay_over, look_behind
from clsplat.render.workspace import Workspace

CHECKS = Checks()


def layer_figures(device: Device, rng: np.random.Generator, width: int, height: int, channels: int) -> Iterator[Figure]:
    """Compare the colours of both, the loss and the derivatives; a sign of T says something else."""
    camera, workspace = camera_of(device, width, height), Workspace(device)
    layer, image = (rng.random((number, height, width)).astype(np.float32) for number in (3, channels))
    left = rng.random((height, width)).astype(np.float32)
    gradient = rng.normal(size=image.shape).astype(np.float32)
    signed = np.where(rng.random(left.shape) < 0.5, -1, 1) * left
    planes = {"image": planes_of(device, camera, layer), "transmittance": planes_of(device, camera, signed[None])}
    frame, what, scale = cast(Any, SimpleNamespace(camera=camera, **planes)), f"{width} x {height} px", 0.01
    found = lay_over(workspace, frame, planes_of(device, camera, image), scale)
    both, behind = found.image.get(), found.behind.get()
    inside = np.s_[..., :height, :width]
    exact = left.astype(np.float64)
    yield by_element("lay_over", f"both, {what}", both[inside], ref.laid_over(layer, exact, image), 1e-6, floor=1.0)
    loss, by_left = ref.layer_cover(exact, scale)
    yield by_element("lay_over", f"T dL/dT, {what}", behind[inside], (exact * by_left)[None], 1e-6, floor=scale)
    yield by_element("lay_over", f"loss, {what}", np.array([found.loss()]), np.array([loss]), SUM, floor=0.1)
    for planes_found in (both, behind):
        yield equal("lay_over", f"pixels outside the image, {what}", outside(camera, planes_found), 0.0)
    by_both = planes_of(device, camera, gradient)
    look_behind(workspace, frame, by_both)
    expected = ref.gradient_behind(exact, gradient)
    yield by_element("look_behind", f"derivatives, {what}", by_both.get()[inside], expected, 1e-6, floor=1.0)


@CHECKS.add("lay_over", "look_behind")
def layer(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for width, height in SIZES:
        for channels in (3, 4):
            yield from layer_figures(device, rng, width, height, channels)
