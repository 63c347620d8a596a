"""Residuals, their numbers by size, and the mask without the large ones."""

from collections.abc import Iterator

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.images import SIZES, camera_of, pictures, planes_of
from clsplat.conformance.comparison import Figure, by_element, equal
from clsplat.opencl.device import Device
from clsplat.render.workspace import Workspace
from clsplat.views.transients import mask_transients, measure_residuals

CHECKS = Checks()
SCALES = (1.0, 1e-2, 8.0)  # of the differences: some lie beyond the bins, on either side


def transient_figures(
    device: Device, rng: np.random.Generator, width: int, height: int, scale: float, share: float | None
) -> Iterator[Figure]:
    """Compare residuals and masks of a picture of which a mask leaves a share; bins and masks are exact."""
    x, y = pictures(rng, width, height)
    x = (y + np.float32(scale) * (x - y)).astype(np.float32)
    counted = np.ones((height, width), bool) if share is None else rng.random((height, width)) < share
    camera, workspace = camera_of(device, width, height), Workspace(device)
    for name in ("residuals", "counted pixels"):
        workspace.array(name, (1, camera.rows, camera.stride)).fill(7)
    mask = None if share is None else planes_of(device, camera, counted[None])
    planes = planes_of(device, camera, x), planes_of(device, camera, y)
    found, waiting = measure_residuals(workspace, camera, *planes, mask)
    what, values = f"{width} x {height} px", found.get()[0, :height, :width]
    exact = ref.residuals(x.astype(np.float64), y.astype(np.float64))
    yield by_element("measure_residuals", f"residuals, {what}", values[counted], exact[counted], 1e-6, floor=1e-6)
    rest = found.get()[0].copy()
    rest[:height, :width][counted] = -1
    yield equal("measure_residuals", f"pixels that do not count, {what}", rest, -1.0)
    numbers = ref.residual_numbers(values[counted].astype(np.float64))
    yield equal("measure_residuals", f"numbers, {what}", waiting(), numbers)
    for quantile, reach in ((0.2, 1), (0.5, 1), (0.6, 3), (0.9, 2)):
        threshold = float(np.float32(np.quantile(values, quantile)))
        kept = mask_transients(workspace, camera, found, threshold, reach).get()[0]
        expected = np.zeros_like(kept)
        expected[:height, :width] = ref.without_transients(values, counted, threshold, reach)
        yield equal("mask_transients", f"mask, {what}", kept, expected)


@CHECKS.add("measure_residuals", "mask_transients")
def transients(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for width, height in SIZES:
        for scale in SCALES:
            yield from transient_figures(device, rng, width, height, scale, None)
            yield from transient_figures(device, rng, width, height, scale, 0.7)
