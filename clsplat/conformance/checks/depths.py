"""inverse_depth.cl, and the fourth plane of blending that it reads."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.blending import BACKGROUND, MARGIN
from clsplat.conformance.checks.images import comparison_of
from clsplat.conformance.comparison import CONIC, GRADIENT, SUM, Figure, by_element, by_norm, equal, image_figures
from clsplat.conformance.scenes import Case, safe_case
from clsplat.conformance.sums import gradients_of_sums
from clsplat.losses.depth import InverseDepth
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Budget, Rasterizer
from clsplat.render.records import INVERSE_DEPTHS
from clsplat.views.known_depths import KnownDepths

CHECKS = Checks()
Floats = NDArray[Any]


def gradients_of(
    device: Device, case: Case, weights: Floats, budget: Budget | None = None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Image [4, H, W], sums over pixels [N, PIXEL_SUMS], those of inverse depths [N], and the gradient of the means
    [N, 3], under the loss Σ weights · (image, inverse depth)."""
    rasterizer, model, camera = Rasterizer(device, "radix", budget), case.model(device), case.device_camera(device)
    frame, (width, height) = rasterizer.forward(model, camera, device.upload(BACKGROUND), "inverse_depth"), case.size
    planes = np.zeros((4, camera.rows, camera.stride), np.float32)
    planes[:, :height, :width] = weights
    count, capacity = model.gaussians.count, model.gaussians.capacity
    sums = rasterizer.pixel_sums(model, frame, device.upload(planes))
    depths = rasterizer.workspace.array(INVERSE_DEPTHS, capacity).get()[:count]
    means = rasterizer.gradients(model, frame, sums)["means"].get()[:, :count].T
    return frame.image.get()[:, :height, :width], sums.get()[:, :count].T.astype(np.float64), depths, means


def depth_figures(device: Device, case: Case, weights: Floats, what: str) -> Iterator[Figure]:
    """Compare image, sums and gradients with the reference."""
    splats, (width, height), background = case.project(), case.size, BACKGROUND.astype(np.float64)
    image, m, depths, means = gradients_of(device, case, weights)
    expected = ref.inverse_depth(splats, width, height)
    yield from image_figures("blend_forward", f"inverse depth, {what}", image[3:], expected[None])
    of_image = ref.blend_backward(splats, width, height, background, weights[:3])
    of_depth, by_depth = ref.inverse_depth_backward(splats, width, height, weights[3])
    mean2d, conic = (getattr(of_image, name) + getattr(of_depth, name) for name in ("mean2d", "conic"))
    opacity = of_image.opacity + of_depth.opacity
    found = gradients_of_sums(splats, m)
    yield by_norm("blend_backward", f"splat means with depths, {what}", found[0], mean2d, GRADIENT)
    yield by_norm("blend_backward", f"conics with depths, {what}", found[1], conic, GRADIENT)
    yield by_norm("blend_backward", f"opacities with depths, {what}", m[:, 0], opacity * splats.opacity, GRADIENT)
    yield by_norm("blend_backward", f"colours with depths, {what}", m[:, 6:9], of_image.colour, GRADIENT)
    sums = -by_depth * np.where(splats.visible, splats.depth, 0) ** 2
    yield by_norm("sum_inverse_depths", f"sums of inverse depths, {what}", depths, sums, GRADIENT)
    upstream = mean2d, conic, opacity, of_image.colour
    numbers = case.degree, case.variance, case.compensate
    truth = ref.project_backward(case.gaussians(), case.camera(), *numbers, splats, *upstream)["means"]
    truth = truth + by_depth[:, None] * case.camera().rotation[2]
    yield by_norm("inverse_depth_backward", f"gradients of means, {what}", means, truth, CONIC)


@CHECKS.add("project_forward", "blend_forward", "blend_backward", "sum_inverse_depths", "inverse_depth_backward")
def inverse_depths(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count, width, height in ((1, 16, 16), (17, 33, 15), (65, 24, 24)):
        case, what = safe_case(rng, count, width, height, MARGIN), f"{count} Gaussians, {width} x {height} px"
        weights = rng.normal(size=(4, height, width)).astype(np.float32)
        yield from depth_figures(device, case, weights, what)
        plain = Rasterizer(device, "radix").forward(
            case.model(device), case.device_camera(device), device.upload(BACKGROUND)
        )
        image, *sums = gradients_of(device, case, weights)
        yield equal("blend_forward", f"colours, {what}", image[:3], plain.image.get()[:, :height, :width])
        for one, other in zip(sums, gradients_of(device, case, weights, Budget(40, 3))[1:], strict=True):
            yield equal("sum_inverse_depths", f"against bands of tiles, {what}", other, one)


@CHECKS.add("inverse_depth_loss")
def losses_of_depths(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for width, height, count in ((1, 1, 1), (17, 33, 64), (40, 20, 65)):
        x = rng.uniform(0, 1, (4, height, width)).astype(np.float32)
        comparison = comparison_of(device, x, x[:3])
        camera = comparison.camera
        comparison.gradient = device.zeros((4, camera.rows, camera.stride))
        flat = rng.permutation(width * height)[:count]
        places = flat // width, flat % width
        targets, weights = rng.uniform(0, 1, (2, count)).astype(np.float32)
        targets[:1] = x[3][places][:1]  # no gradient where they are equal
        pixels = device.upload((places[0] * camera.stride + places[1]).astype(np.uint32))
        comparison.depths = KnownDepths(pixels, device.upload(targets), device.upload(weights), 3.0)
        value, scale = InverseDepth(weight=0.5).add(comparison).value(), 0.5 * 3 / count
        expected, by_plane = ref.inverse_depth_loss(x[3].astype(np.float64), places, targets, weights)
        what = f"{count} pixels of {width} x {height}"
        terms = comparison.workspace.array("inverse_depth_terms", count).get()
        yield by_element("inverse_depth_loss", f"terms, {what}", terms, expected, SUM, floor=1e-3)
        total = np.array([scale * expected.sum()])
        yield by_element("inverse_depth_loss", f"value, {what}", np.array([value]), total, SUM, floor=1e-6)
        found, truth = comparison.gradient.get(), np.zeros(comparison.gradient.shape)
        truth[3, :height, :width] = scale * by_plane
        yield by_element("inverse_depth_loss", f"gradient, {what}", found, truth, SUM, floor=1e-9)
