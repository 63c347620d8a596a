"""Check blending: images, the sums over pixels from which gradients are computed, inverse depths, and layers."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Results, Tol, check_image, compare, compare_max, count_true, match
from clsplat.conformance.checks.images import SIZES, blank_image, make_camera, make_comparison, to_planes
from clsplat.conformance.scenes import Case, random_case, safe_case, sums_to_gradients
from clsplat.density.statistics import ABS_X
from clsplat.density.survey import BLENDED, SQUARE, WEIGHT
from clsplat.losses.depth import InverseDepth
from clsplat.opencl.device import Device
from clsplat.photos.depths import KnownDepths
from clsplat.render.overlay import backpropagate_composite, composite_layer
from clsplat.render.rasterizer import (
    BUCKET,
    INVERSE_DEPTHS,
    PIXEL_SUMS,
    RECORD,
    Frame,
    Rasterizer,
    RenderLimits,
)
from clsplat.render.tiles import Sort
from clsplat.render.workspace import Workspace

CHECKS = Checks()
BACKGROUND = np.array([0.2, 0.5, 0.9], np.float32)
MARGIN = 1e-5  # distance of alpha and transmittance from thresholds: float32 errors are about 3e-6
ALL_SUMS = SQUARE + 1
Sums = tuple[NDArray[Any], Frame, Rasterizer]


def render(device: Device, case: Case, sort: Sort = "radix") -> Frame:
    return Rasterizer(device, sort).forward(case.model(device), case.device_camera(device), device.upload(BACKGROUND))


def check_blend(device: Device, case: Case, label: str, sort: Sort = "radix") -> Results:
    """Compare the image and the transmittance of a scene, and check that their padding is zero."""
    frame, (width, height) = render(device, case, sort), case.size
    image, transmittance = frame.image.get(), frame.transmittance.get()
    outside = np.concatenate([image, transmittance[None]])
    outside[:, :height, :width] = 0
    yield match("blend_forward", f"pixels outside the image, {label}", outside, 0.0)
    truth, true_transmittance, _ = ref.blend(case.project(), width, height, BACKGROUND.astype(np.float64))
    yield from check_image("blend_forward", f"image, {label}", image[:, :height, :width], truth)
    actual = transmittance[None, :height, :width]
    yield from check_image("blend_forward", f"transmittance, {label}", actual, true_transmittance[None])


def sum_pixels(
    device: Device,
    case: Case,
    weights: NDArray[Any],
    count: int = PIXEL_SUMS,
    sort: Sort = "radix",
    budget: RenderLimits | None = None,
    texture: NDArray[Any] | None = None,
) -> NDArray[Any]:
    """Return the sums over each Gaussian's pixels for the loss Σ weights · image, [N, count]."""
    rasterizer, model, camera = Rasterizer(device, sort, budget), case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
    planes = np.zeros((4, camera.rows, camera.stride), np.float32)
    planes[:3, : camera.height, : camera.width] = weights
    if texture is not None:
        planes[3, : camera.height, : camera.width] = texture
    texture_array = None if texture is None else device.upload(planes[3])
    rasterizer.workspace.array("pair_sums", (frame.lists.pairs, RECORD)).fill(np.nan)  # all must be overwritten
    pixel_sums = rasterizer.pixel_sums(model, frame, device.upload(planes[:3]), count, texture_array)
    return pixel_sums.get()[:, : model.gaussians.count].T.astype(np.float64)


def check_sum(case: Case, sums: NDArray[Any], weights: NDArray[Any], label: str) -> Results:
    """Compare sums over pixels, [N, PIXEL_SUMS or more], after conversion to gradients of splats."""
    kernel, splats = "blend_backward", case.project()
    truth = ref.blend_backward(splats, *case.size, BACKGROUND.astype(np.float64), weights)
    mean2d, conic = sums_to_gradients(splats, sums)
    yield compare(kernel, f"gradients of splat means, {label}", mean2d, truth.mean2d, Tol.GRADIENT)
    yield compare(kernel, f"gradients of conics, {label}", conic, truth.conic, Tol.GRADIENT)
    yield compare(kernel, f"gradients of opacities, {label}", sums[:, 0], truth.opacity * splats.opacity, Tol.GRADIENT)
    yield compare(kernel, f"gradients of colors, {label}", sums[:, 6:9], truth.color, Tol.GRADIENT)
    if sums.shape[1] > PIXEL_SUMS:
        actual = sums[:, ABS_X : ABS_X + 2]
        yield compare(kernel, f"absolute gradients, {label}", actual, truth.mean2d_abs, Tol.GRADIENT)


def _make_opaque(parameters: dict[str, NDArray[Any]]) -> None:
    parameters["log_scales"] += 0.6
    parameters["logit_opacity"] += 2


def make_dim(parameters: dict[str, NDArray[Any]]) -> None:
    """Make splats so faint that the transmittance is below 0.01 after 256 splats, but 40 more still contribute."""
    parameters["log_scales"] += 4
    parameters["logit_opacity"][:] = -3.7


def _vary_sizes(parameters: dict[str, NDArray[Any]]) -> None:
    parameters["log_scales"][:10] += 4
    parameters["log_scales"][10:20] -= 6


@CHECKS.add("blend_forward")
def images(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in ((0, 20, 20), (1, 16, 16), (17, 15, 17), (60, 33, 31), (120, 40, 30), (40, 5, 3)):
        case = safe_case(rng, count, width, height, MARGIN)
        yield from check_blend(device, case, f"{count} Gaussians, {width} x {height} px")
    yield from check_blend(device, safe_case(rng, 300, 14, 14, 2e-6, _make_opaque), "long tiles, finished pixels")
    yield from check_blend(device, safe_case(rng, 300, 14, 14, 2e-6, make_dim), "long tiles, dim pixels")
    yield from check_blend(device, safe_case(rng, 30, 40, 40, MARGIN, _vary_sizes), "huge and tiny splats")


@CHECKS.add("blend_backward", "sum_records")
def gradients_of_blending(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in ((1, 16, 16), (17, 33, 15), (40, 40, 30), (65, 24, 24)):
        case = safe_case(rng, count, width, height, MARGIN)
        weights = rng.normal(size=(3, height, width)).astype(np.float32)
        label = f"{count} Gaussians, {width} x {height} px"
        yield from check_sum(case, sum_pixels(device, case, weights), weights, label)
    case = safe_case(rng, 300, 14, 14, 2e-6, _make_opaque)
    weights = rng.normal(size=(3, 14, 14)).astype(np.float32)
    yield from check_sum(case, sum_pixels(device, case, weights), weights, "long tiles, finished pixels")
    case = safe_case(rng, 300, 14, 14, 2e-6, make_dim)
    yield from check_sum(case, sum_pixels(device, case, weights), weights, "long tiles, dim pixels")


def make_faint(parameters: dict[str, NDArray[Any]]) -> None:
    """Make splats so faint and large that each pixel blends about 900 of them."""
    parameters["log_scales"] += 4
    parameters["logit_opacity"][:] = -4.6


@CHECKS.add("blend_backward", "sum_records")
def gradients_of_long_lists(device: Device, rng: np.random.Generator) -> Results:
    width, height = 5, 4
    for count in (BUCKET - 1, BUCKET, BUCKET + 1, 2 * BUCKET):
        case = random_case(rng, count, width, height)
        make_faint(case.parameters)
        weights = rng.normal(size=(3, height, width)).astype(np.float32)
        yield from check_sum(case, sum_pixels(device, case, weights), weights, f"{count} Gaussians")


@CHECKS.add("blend_backward", "sum_records")
def statistics_of_blending(device: Device, rng: np.random.Generator) -> Results:
    width, height = 48, 32  # multiples of all tile sizes, so that the texture covers the padding
    case = safe_case(rng, 40, width, height, MARGIN)
    weights = rng.normal(size=(3, height, width)).astype(np.float32)
    texture = np.where(rng.random((height, width)) < 0.9, rng.uniform(0, 0.5, (height, width)), -1).astype(np.float32)
    yield from check_sum(case, sum_pixels(device, case, weights, ABS_X + 2), weights, "with absolute gradients")
    sums = sum_pixels(device, case, weights, ALL_SUMS, texture=texture)
    yield from check_sum(case, sums, weights, "with weights and texture")
    blend_weights = ref.blend_weights(case.project(), width, height) * (texture >= 0)
    yield compare("blend_backward", "sums of weights", sums[:, WEIGHT], blend_weights.sum(axis=(1, 2)), Tol.GRADIENT)
    expected = (blend_weights * texture).sum(axis=(1, 2))
    yield compare("blend_backward", "sums of texture", sums[:, WEIGHT + 1], expected, Tol.GRADIENT)
    squares = ref.falloff_squares(case.project(), width, height, BACKGROUND.astype(np.float64), weights)
    yield compare("blend_backward", "sums of squares", sums[:, SQUARE], squares, Tol.GRADIENT)
    flags = np.where(texture < 0, -1, texture > 0.3).astype(np.float32)
    for scene in (case, safe_case(rng, 300, width, height, 2e-6, _make_opaque)):  # finished pixels
        counts = sum_pixels(device, scene, weights, ALL_SUMS, texture=flags)[:, BLENDED]
        expected = (ref.blend_weights(scene.project(), width, height) > 0) * (flags > 0)
        yield match("blend_backward", "numbers of pixels", counts, expected.sum(axis=(1, 2)))
    yield from check_sum(case, sum_pixels(device, case, weights, WEIGHT + 2, texture=flags), weights, "fewer sums")


@CHECKS.add("blend_backward")
def loss_of_what_is_left(device: Device, rng: np.random.Generator) -> Results:
    """Compare a loss on the transmittance with the same loss on an image of black splats on a white background."""
    for count, width, height in ((1, 16, 16), (17, 33, 15), (65, 24, 24)):
        case, label = safe_case(rng, count, width, height, MARGIN), f"with the transmittance, {count} Gaussians"
        rasterizer, model, camera = Rasterizer(device, "radix"), case.model(device), case.device_camera(device)
        frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
        planes = np.zeros((4, camera.rows, camera.stride), np.float32)
        planes[:, :height, :width] = rng.normal(size=(4, height, width))
        behind = device.upload(planes[3] * np.abs(frame.transmittance.get()))
        sums = rasterizer.pixel_sums(model, frame, device.upload(planes[:3]), transmittance_gradient=behind)
        splats, weights = case.project(), planes[:, :height, :width].astype(np.float64)
        image_gradients = ref.blend_backward(splats, width, height, BACKGROUND.astype(np.float64), weights[:3])
        black, channel = replace(splats, color=0 * splats.color), np.stack([weights[3], *np.zeros((2, height, width))])
        alpha_gradients = ref.blend_backward(black, width, height, np.array([1.0, 0, 0]), channel)
        mean2d, conic = sums_to_gradients(splats, sums.get()[:, :count].T.astype(np.float64))
        yield compare(
            "blend_backward",
            f"splat means, {label}",
            mean2d,
            image_gradients.mean2d + alpha_gradients.mean2d,
            Tol.GRADIENT,
        )
        yield compare(
            "blend_backward", f"conics, {label}", conic, image_gradients.conic + alpha_gradients.conic, Tol.GRADIENT
        )
        opacity = (image_gradients.opacity + alpha_gradients.opacity) * splats.opacity
        yield compare("blend_backward", f"opacities, {label}", sums.get()[0, :count], opacity, Tol.GRADIENT)


@CHECKS.add("sum_records")
def sums_of_records(device: Device, rng: np.random.Generator) -> Results:
    lanes = int(device.tuning["LANES"])
    for count in (1, 15, 17, 65):
        pairs, stride = rng.integers(0, 6, count), -(-count // 64) * 64
        records = rng.uniform(0.5, 1, (max(1, pairs.sum()), RECORD)).astype(np.float32)
        first = np.cumsum(pairs) - pairs
        sums = rng.uniform(0.5, 1, (PIXEL_SUMS, stride)).astype(np.float32)
        expected = np.stack([records[f : f + n].sum(axis=0) for f, n in zip(first, pairs, strict=True)], axis=1)
        for accumulate in (0, 1):
            pixel_sums = device.upload(sums)
            device.program("gather.cl").sum_records(
                items=-(-count // lanes),
                pair_sums=device.upload(records),
                first_pair=device.upload(first.astype(np.uint32)),
                tile_count=device.upload(pairs.astype(np.uint32)),
                pixel_sums=pixel_sums,
                accumulate=accumulate,
                stride=stride,
                count=count,
            )
            truth = expected[:PIXEL_SUMS] + accumulate * sums[:, :count].astype(np.float64)
            yield compare("sum_records", f"sums of {count} Gaussians", pixel_sums.get()[:, :count], truth, Tol.SUM)


@CHECKS.add("blend_forward", "blend_backward")
def the_same_bits_with_either_sort_and_in_bands(device: Device, rng: np.random.Generator) -> Results:
    case = random_case(rng, 150, 50, 70)
    case.parameters["log_scales"][:10] += 1.5  # some cover many rows of tiles, and more tiles than a mask has bits
    weights = rng.normal(size=(3, 70, 50)).astype(np.float32)
    image, sums = render(device, case).image.get(), sum_pixels(device, case, weights)
    yield match("sort_tiles", "pixels, against the radix sort", render(device, case, "bitonic").image.get(), image)
    bitonic_sums = sum_pixels(device, case, weights, sort="bitonic")
    yield match("sort_tiles", "sums over pixels, against the radix sort", bitonic_sums, sums)
    band_sums = sum_pixels(device, case, weights, budget=RenderLimits(250, 3))
    yield match("blend_backward", "sums over pixels, against bands of tiles", band_sums, sums)
    yield match("blend_backward", "sums over pixels, a second time", sum_pixels(device, case, weights), sums)


# inverse_depth.cl, and the fourth plane of blending, its input.

Floats = NDArray[Any]


def differentiate(
    device: Device, case: Case, weights: Floats, budget: RenderLimits | None = None
) -> tuple[Floats, Floats, Floats, Floats]:
    """Render colors and inverse depth, and differentiate the loss Σ weights · (image, inverse depth).

    Return the image, [4, H, W], sums over pixels, [N, PIXEL_SUMS], sums of inverse depths, [N], and the gradient of the
    means, [N, 3].  weights: [4, H, W].
    """
    rasterizer, model, camera = Rasterizer(device, "radix", budget), case.model(device), case.device_camera(device)
    frame, (width, height) = rasterizer.forward(model, camera, device.upload(BACKGROUND), "inverse_depth"), case.size
    planes = np.zeros((4, camera.rows, camera.stride), np.float32)
    planes[:, :height, :width] = weights
    count, capacity = model.gaussians.count, model.gaussians.capacity
    sums = rasterizer.pixel_sums(model, frame, device.upload(planes))
    depth_sums = rasterizer.workspace.array(INVERSE_DEPTHS, capacity).get()[:count]
    grad_means = rasterizer.gradients(model, frame, sums)["means"].get()[:, :count].T
    return frame.image.get()[:, :height, :width], sums.get()[:, :count].T.astype(np.float64), depth_sums, grad_means


def check_depth(device: Device, case: Case, weights: Floats, label: str) -> Results:
    """Compare the inverse depth, the sums over pixels and the gradients.  weights: as in `differentiate`."""
    splats, (width, height), background = case.project(), case.size, BACKGROUND.astype(np.float64)
    image, pixel_sums, depth_sums, grad_means = differentiate(device, case, weights)
    expected = ref.inverse_depth(splats, width, height)
    yield from check_image("blend_forward", f"inverse depth, {label}", image[3:], expected[None])
    image_gradients = ref.blend_backward(splats, width, height, background, weights[:3])
    depth_gradients, grad_depth = ref.inverse_depth_backward(splats, width, height, weights[3])
    mean2d, conic = (getattr(image_gradients, name) + getattr(depth_gradients, name) for name in ("mean2d", "conic"))
    opacity = image_gradients.opacity + depth_gradients.opacity
    actual = sums_to_gradients(splats, pixel_sums)
    yield compare("blend_backward", f"splat means with depths, {label}", actual[0], mean2d, Tol.GRADIENT)
    yield compare("blend_backward", f"conics with depths, {label}", actual[1], conic, Tol.GRADIENT)
    yield compare(
        "blend_backward", f"opacities with depths, {label}", pixel_sums[:, 0], opacity * splats.opacity, Tol.GRADIENT
    )
    yield compare(
        "blend_backward", f"colors with depths, {label}", pixel_sums[:, 6:9], image_gradients.color, Tol.GRADIENT
    )
    sums = -grad_depth * np.where(splats.visible, splats.depth, 0) ** 2
    yield compare("sum_inverse_depths", f"sums of inverse depths, {label}", depth_sums, sums, Tol.GRADIENT)
    upstream = mean2d, conic, opacity, image_gradients.color
    settings = case.degree, case.variance, case.compensate
    truth = ref.project_backward(case.gaussians(), case.camera(), *settings, splats, *upstream)["means"]
    truth = truth + grad_depth[:, None] * case.camera().rotation[2]
    yield compare("inverse_depth_backward", f"gradients of means, {label}", grad_means, truth, Tol.CONIC)


@CHECKS.add("project_forward", "blend_forward", "blend_backward", "sum_inverse_depths", "inverse_depth_backward")
def inverse_depths(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in ((1, 16, 16), (17, 33, 15), (65, 24, 24)):
        case, label = safe_case(rng, count, width, height, MARGIN), f"{count} Gaussians, {width} x {height} px"
        weights = rng.normal(size=(4, height, width)).astype(np.float32)
        yield from check_depth(device, case, weights, label)
        color_frame = Rasterizer(device, "radix").forward(
            case.model(device), case.device_camera(device), device.upload(BACKGROUND)
        )
        image, *sums = differentiate(device, case, weights)
        yield match("blend_forward", f"colors, {label}", image[:3], color_frame.image.get()[:, :height, :width])
        for actual, band_sums in zip(sums, differentiate(device, case, weights, RenderLimits(40, 3))[1:], strict=True):
            yield match("sum_inverse_depths", f"against bands of tiles, {label}", band_sums, actual)


@CHECKS.add("blend_forward")
def median_depths(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in ((0, 16, 16), (1, 16, 16), (17, 33, 15), (120, 24, 24)):
        case = safe_case(rng, count, width, height, MARGIN, _make_opaque)
        label = f"{count} Gaussians, {width} x {height} px"
        rasterizer, camera = Rasterizer(device, "radix"), case.device_camera(device)
        image = rasterizer.forward(case.model(device), camera, device.zeros(3), "depth").image.get()
        expected, gap = ref.median_depth(case.project(), width, height)
        is_safe = gap > MARGIN
        yield count_true("blend_forward", f"median depths near a step, {label}", ~is_safe, limit=0.02 * is_safe.size)
        actual = image[2, :height, :width]
        yield compare_max("blend_forward", f"median depths, {label}", actual[is_safe], expected[is_safe], Tol.DEPTH)


@CHECKS.add("inverse_depth_loss")
def losses_of_depths(device: Device, rng: np.random.Generator) -> Results:
    for width, height, count in ((1, 1, 1), (17, 33, 64), (40, 20, 65)):
        x = rng.uniform(0, 1, (4, height, width)).astype(np.float32)
        comparison = make_comparison(device, x, x[:3])
        camera = comparison.camera
        comparison.gradient = device.zeros((4, camera.rows, camera.stride))
        indices = rng.permutation(width * height)[:count]
        rows, columns = positions = indices // width, indices % width
        targets, weights = rng.uniform(0, 1, (2, count)).astype(np.float32)
        targets[:1] = x[3][positions][:1]  # equal values have no gradient
        pixels = device.upload((rows * camera.stride + columns).astype(np.uint32))
        comparison.depths = KnownDepths(pixels, device.upload(targets), device.upload(weights), 3.0)
        value, scale = InverseDepth(weight=0.5).add(comparison).value(), 0.5 * 3 / count
        expected, grad_plane = ref.inverse_depth_loss(x[3].astype(np.float64), positions, targets, weights)
        label = f"{count} pixels of {width} x {height}"
        terms = comparison.workspace.array("inverse_depth_terms", count).get()
        yield compare_max("inverse_depth_loss", f"terms, {label}", terms, expected, Tol.SUM, floor=1e-3)
        total = np.array([scale * expected.sum()])
        yield compare_max("inverse_depth_loss", f"value, {label}", np.array([value]), total, Tol.SUM, floor=1e-6)
        actual, truth = comparison.gradient.get(), np.zeros(comparison.gradient.shape)
        truth[3, :height, :width] = scale * grad_plane
        yield compare_max("inverse_depth_loss", f"gradient, {label}", actual, truth, Tol.SUM, floor=1e-9)


# layer.cl: a layer of splats in front of an image.


def check_layer(device: Device, rng: np.random.Generator, width: int, height: int, channels: int) -> Results:
    """Compare the composite, the loss and the gradients; the sign of the transmittance does not matter."""
    camera, workspace = make_camera(device, width, height), Workspace(device)
    layer, image = (rng.random((count, height, width)).astype(np.float32) for count in (3, channels))
    transmittance = rng.random((height, width)).astype(np.float32)
    gradient = rng.normal(size=image.shape).astype(np.float32)
    signed_transmittance = np.where(rng.random(transmittance.shape) < 0.5, -1, 1) * transmittance
    planes = {
        "image": to_planes(device, camera, layer),
        "transmittance": to_planes(device, camera, signed_transmittance[None]),
    }
    frame, label, scale = cast(Any, SimpleNamespace(camera=camera, **planes)), f"{width} x {height} px", 0.01
    actual = composite_layer(workspace, frame, to_planes(device, camera, image), scale)
    composite, behind = actual.image.get(), actual.transmittance_gradient.get()
    inside = np.s_[..., :height, :width]
    exact = transmittance.astype(np.float64)
    yield compare_max("lay_over", f"sum, {label}", composite[inside], ref.overlay(layer, exact, image), 1e-6, floor=1.0)
    loss, grad_t = ref.layer_cover(exact, scale)
    yield compare_max("lay_over", f"T dL/dT, {label}", behind[inside], (exact * grad_t)[None], 1e-6, floor=scale)
    yield compare_max("lay_over", f"loss, {label}", np.array([actual.loss()]), np.array([loss]), Tol.SUM, floor=0.1)
    for output in (composite, behind):
        yield match("lay_over", f"pixels outside the image, {label}", blank_image(camera, output), 0.0)
    actual_gradient = to_planes(device, camera, gradient)
    backpropagate_composite(workspace, frame, actual_gradient)
    expected = ref.gradient_behind(exact, gradient)
    yield compare_max("look_behind", f"derivatives, {label}", actual_gradient.get()[inside], expected, 1e-6, floor=1.0)


@CHECKS.add("lay_over", "look_behind")
def layer(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        for channels in (3, 4):
            yield from check_layer(device, rng, width, height, channels)
