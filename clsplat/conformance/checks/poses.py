"""poses.cl: derivatives by the place and the focal length of a camera."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.projection import beyond_the_clamp
from clsplat.conformance.comparison import CONIC, Figure, by_norm
from clsplat.conformance.scenes import Case, random_case, with_world_filter
from clsplat.conformance.sums import gradients_of_sums
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.views.photograph_poses import pose_gradient

CHECKS = Checks()


def pose_figures(device: Device, case: Case, rng: np.random.Generator, what: str) -> Iterator[Figure]:
    """Give the kernel and the reference the same sums over a Gaussian's pixels; compare the pose's derivatives."""
    model, camera, rasterizer = case.model(device), case.device_camera(device), Rasterizer(device, "radix")
    frame, count = rasterizer.forward(model, camera, device.zeros(3)), model.gaussians.count
    pixel_sums = np.full((PIXEL_SUMS, model.gaussians.capacity), np.nan, np.float32)
    drawn = frame.splats.get()[:, 5] > 0
    pixel_sums[:, :count] = rng.normal(size=(PIXEL_SUMS, count)) * drawn
    found = pose_gradient(rasterizer.workspace, model, frame, device.upload(pixel_sums))()
    m, truth = pixel_sums[:, :count].astype(np.float64).T, case.project()
    grad_mean2d, grad_conic = gradients_of_sums(truth, m)
    by_opacity = np.where(truth.visible, m[:, 0] / np.where(truth.visible, truth.opacity, 1), 0)
    upstream = grad_mean2d, grad_conic, by_opacity, m[:, 6:9]
    numbers = case.degree, case.variance, case.compensate
    expected = ref.pose_gradient(case.gaussians(), case.camera(), *numbers, truth, *upstream)
    turn = case.camera().rotation
    values = {"shift": turn @ found[:3], "turn": turn @ found[3:6], "focal length": found[6:]}
    for (name, value), exact in zip(values.items(), expected, strict=True):
        yield by_norm("pose_gradient", f"derivative by the {name}, {what}", value[None], exact[None], CONIC)


@CHECKS.add("pose_gradient")
def poses(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count in (1, 15, 17, 65, 600):
        yield from pose_figures(device, random_case(rng, count), rng, f"{count} Gaussians")
    for degree in range(3):
        yield from pose_figures(device, random_case(rng, 20, degree=degree), rng, f"harmonics of degree {degree}")
    for variance, compensate in ((0.1, 1.0), (0.0, 0.0)):
        case = with_world_filter(random_case(rng, 30, variance=variance, compensate=compensate), rng)
        yield from pose_figures(device, case, rng, f"filters of {variance:g} px², compensate {compensate:g}")
    yield from pose_figures(device, beyond_the_clamp(rng), rng, "rays beyond the limits")
    case = replace(random_case(rng, 30), variance=0.0, pixel_box=1.0)
    yield from pose_figures(device, case, rng, "the pixel's box")
