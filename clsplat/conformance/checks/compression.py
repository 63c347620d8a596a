"""What compression of a model computes on the device: each Gaussian's contribution."""

from collections.abc import Iterator

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.comparison import SUM, Figure, by_element, equal
from clsplat.conformance.scenes import Case, safe_case
from clsplat.density.contribution import contributions
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.views.photographs import Mask, Photograph

CHECKS = Checks()
SIZES = ((1, 16, 16), (17, 33, 15), (30, 40, 30))  # Gaussians, and px: tiles that end at the edge, and beyond it


def photograph_of(device: Device, case: Case, mask: Mask | None = None) -> Photograph:
    """A black photograph at the camera of a scene."""
    camera = case.device_camera(device)
    colours = device.upload(np.zeros((3, camera.height, camera.width), np.uint8))
    return Photograph(camera, colours, None if mask is None else device.upload(mask[None].astype(np.uint8)))


@CHECKS.add("accumulate_pixel_sum", "blend_backward")
def contribution(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count, width, height in SIZES:
        case = safe_case(rng, count, width, height, MARGIN)
        masks = (None, rng.random((height, width)) < 0.6)
        photographs = [photograph_of(device, case, mask) for mask in masks]
        expected = sum(ref.contribution(case.project(), width, height, mask) for mask in masks)
        found, again = (contributions(Rasterizer(device, "radix"), case.model(device), photographs) for _ in range(2))
        what = f"blend weights of {count} Gaussians"
        yield by_element("accumulate_pixel_sum", what, found, np.asarray(expected), SUM, floor=0.1)
        yield equal("accumulate_pixel_sum", f"{what}, a second time", again, found)
