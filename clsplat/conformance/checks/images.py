"""Check kernels on pixels: losses, masks, blur, texture, transients, and the fusion of depth images."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Deviation, Results, Tol, compare_max, count_true, match
from clsplat.conformance.scenes import Case, random_case
from clsplat.losses.base import Comparison, ImageLoss
from clsplat.losses.image import L1, L2, Dssim, add_losses, view_error
from clsplat.methods.opti3dgs import apply_filter, filter_gradients
from clsplat.opencl.device import Array, Device
from clsplat.photos.photographs import apply_mask, change_background, unmasked_gradient, unpack
from clsplat.photos.transforms import Blur, Planes
from clsplat.render.camera import DeviceCamera
from clsplat.render.fusion import SIDE, DepthImage, count_free, integrate
from clsplat.render.workspace import Workspace
from clsplat.training.modules.transients import mask_transients, measure_residuals

CHECKS = Checks()
SIZES = ((1, 1), (11, 11), (17, 33), (257, 9))  # around the size of the SSIM window, of tiles, and of a group's columns
LOSSES = ((L1, ref.l1, "pixel_loss"), (L2, ref.l2, "pixel_loss"), (Dssim, ref.dssim, "ssim_gradient"))


def make_camera(device: Device, width: int, height: int) -> DeviceCamera:
    tile = int(device.tuning["TILE"])
    return DeviceCamera(device.zeros(1), width, height, -(-width // tile), -(-height // tile), tile)


def to_planes(device: Device, camera: DeviceCamera, image: NDArray[Any]) -> Array:
    """Upload an image, [C, height, width], as planes, which are zero-padded to complete tiles."""
    planes = np.zeros((len(image), camera.rows, camera.stride), np.float32)
    planes[:, : camera.height, : camera.width] = image
    return device.upload(planes)


def blank_image(camera: DeviceCamera, planes: NDArray[Any]) -> NDArray[Any]:
    """Return a copy of the planes in which the image is zero and the padding is unchanged."""
    padding = planes.copy()
    padding[..., : camera.height, : camera.width] = 0
    return padding


def make_comparison(device: Device, x: NDArray[Any], y: NDArray[Any]) -> Comparison:
    """Return a comparison of a render x and a photograph y, [3, H, W]."""
    camera = make_camera(device, x.shape[2], x.shape[1])
    gradient = device.empty((3, camera.rows, camera.stride))
    gradient.fill(7)
    return Comparison(Workspace(device), camera, to_planes(device, camera, x), to_planes(device, camera, y), gradient)


def image_pair(rng: np.random.Generator, width: int, height: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return a noisy render and its photograph, [3, H, W].  Some pixels are equal."""
    y = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    x = (y + rng.normal(0, 0.2, y.shape)).astype(np.float32)
    x[:, 1::3, 1::4] = y[:, 1::3, 1::4]
    return x, y


def check_loss(
    device: Device, loss: ImageLoss, weight: float, oracle: Any, kernel: str, x: NDArray[Any], y: NDArray[Any]
) -> Results:
    """Compare the value and the gradient of a loss."""
    comparison, label = make_comparison(device, x, y), f"{type(loss).__name__}, {x.shape[2]} x {x.shape[1]} px"
    actual = loss.add(comparison)
    value, gradient = oracle(x.astype(np.float64), y.astype(np.float64))
    value_kernel = {"ssim_gradient": "ssim_maps"}.get(kernel, kernel)
    values = np.array([actual.value()]), np.array([weight * value])
    yield compare_max(value_kernel, f"value of {label}", *values, Tol.SUM, floor=1e-2)
    planes, camera = comparison.gradient.get(), comparison.camera
    error = np.abs(planes[:, : camera.height, : camera.width] - weight * gradient).max()
    max_gradient = max(float(np.abs(weight * gradient).max()), 1e-30)
    yield Deviation(kernel, f"gradient of {label}", float(error) / max_gradient, Tol.LOSS_GRADIENT)
    yield match(kernel, f"gradient outside the image, {label}", blank_image(camera, planes), 0.0)


@CHECKS.add("pixel_loss", "ssim_maps", "ssim_gradient")
def losses(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        x, y = image_pair(rng, width, height)
        for loss, oracle, kernel in LOSSES:
            yield from check_loss(device, loss(weight=0.7), 0.7, oracle, kernel, x, y)


@CHECKS.add("pixel_loss", "ssim_gradient")
def losses_that_add_up(device: Device, rng: np.random.Generator) -> Results:
    for order in ((0, 1, 2), (1, 0, 2), (0, 2)):  # the kernel of the SSIM also adds an L1 directly before it
        x, y = image_pair(rng, 50, 20)
        comparison, exact = make_comparison(device, x, y), (x.astype(np.float64), y.astype(np.float64))
        chosen = [(weight, *LOSSES[i][:2]) for i in order for weight in ((0.8, 3.0, 0.2)[i],)]
        values = add_losses([loss(weight=weight) for weight, loss, _ in chosen], comparison)
        truths = [(weight * value, weight * gradient) for weight, _, f in chosen for value, gradient in (f(*exact),)]
        label, expected = ", ".join(value.name for value in values), sum(gradient for _, gradient in truths)
        error = np.abs(comparison.gradient.get()[:, :20, :50] - expected).max() / np.abs(expected).max()
        yield Deviation("ssim_gradient", f"sum of the gradients of {label}", float(error), Tol.LOSS_GRADIENT)
        actual, truth = np.array([value.value() for value in values]), np.array([value for value, _ in truths])
        yield compare_max("ssim_gradient", f"values of {label}", actual, truth, Tol.SUM, floor=1e-2)


@CHECKS.add("view_error", "sum_errors")
def errors_of_views(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        (x, y), label = image_pair(rng, width, height), f"{width} x {height} px"
        gradient, comparison = rng.normal(size=x.shape).astype(np.float32), make_comparison(device, x, y)
        comparison.gradient = to_planes(device, comparison.camera, gradient)
        actual = view_error(comparison).get()
        rows = comparison.workspace.array("row_errors", (3, comparison.camera.rows)).get()
        values = [table.astype(np.float64) for table in (gradient, x, y)]
        expected = np.array([[ref.view_error(*(v[c, row] for v in values)) for row in range(height)] for c in range(3)])
        yield compare_max("view_error", f"errors of rows, {label}", rows[:, :height], expected, Tol.SUM, floor=1e-2)
        yield match("view_error", f"errors of rows outside the image, {label}", rows[:, height:], 0.0)
        yield compare_max("sum_errors", f"error of {label}", actual, np.array([expected.sum()]), Tol.SUM)


@CHECKS.add("unpack_pixels", "apply_mask", "change_background")
def photographs(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        pixels = rng.integers(0, 256, (3, height, width)).astype(np.uint8)
        mask = (rng.random((1, height, width)) < 0.5).astype(np.uint8)
        camera, workspace, label = make_camera(device, width, height), Workspace(device), f"{width} x {height} px"
        workspace.array("photograph", (3, camera.rows, camera.stride)).fill(9)
        colors = unpack(workspace, camera, device.upload(pixels), 1 / 255, "photograph")
        mask_plane = unpack(workspace, camera, device.upload(mask), 1.0, "mask")
        actual = colors.get()
        yield compare_max("unpack_pixels", f"colors, {label}", actual[:, :height, :width], pixels / 255, 1e-6)
        yield match("unpack_pixels", f"pixels outside the image, {label}", blank_image(camera, actual), 0.0)
        yield match("unpack_pixels", f"mask, {label}", mask_plane.get()[:, :height, :width], mask)
        apply_mask(workspace, camera, colors, mask_plane)
        yield match("apply_mask", f"masked colors, {label}", colors.get(), actual * mask_plane.get())
        transparency, old_color, new_color = pixels[:1], *rng.random((2, 3)).astype(np.float32)
        inputs = device.upload(np.ascontiguousarray(transparency)), device.upload(old_color), device.upload(new_color)
        truth = colors.get().astype(np.float64)
        change_background(workspace, camera, colors, *inputs)
        truth[:, :height, :width] += transparency / 255 * (new_color - old_color.astype(np.float64))[:, None, None]
        yield compare_max("change_background", f"colors, {label}", colors.get(), truth, 1e-6, floor=1.0)


@CHECKS.add("blur_rows", "blur_columns")
def blur(device: Device, rng: np.random.Generator) -> Results:
    for width, height in ((1, 1), (15, 4), (33, 18), (65, 7)):
        for sigma, fraction in ((1.0, None), (2.5, 0.7), (0.5, 0.05)):
            image = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
            mask = None if fraction is None else rng.random((height, width)) < fraction
            camera, workspace = make_camera(device, width, height), Workspace(device)
            mask_plane = None if mask is None else to_planes(device, camera, mask[None])
            planes = Planes(workspace, camera, to_planes(device, camera, image), mask_plane)
            actual = Blur(sigma=sigma).apply(planes, step=1).colors.get()
            expected = ref.blur(image.astype(np.float64), sigma, mask)
            label = f"colors, sigma {sigma:g}, {width} x {height} px"
            yield compare_max("blur_columns", label, actual[:, :height, :width], expected, 2e-5, floor=0.05)
            yield match("blur_columns", f"pixels outside the image, {label}", blank_image(camera, actual), 0.0)


def check_haar(
    device: Device, rng: np.random.Generator, width: int, height: int, fraction: float | None, taps: NDArray[Any]
) -> Results:
    """Compare a Haar-filtered image and the gradient of the taps.  A `fraction` of the pixels is unmasked."""
    image, gradient = rng.uniform(0, 1, (3, height, width)).astype(np.float32), rng.normal(size=(3, height, width))
    mask = None if fraction is None else rng.random((height, width)) < fraction
    camera, workspace = make_camera(device, width, height), Workspace(device)
    label = f"{width} x {height} px, h = {taps}"
    for name in ("haar", "haar sums"):
        workspace.array(name, (3, camera.rows, camera.stride)).fill(np.nan)
    mask_plane = None if mask is None else to_planes(device, camera, mask[None])
    scalars = {"haar/scale": (taps[0] - taps[1]) / np.sqrt(2), "haar/leak": taps.sum() / np.sqrt(2)}
    planes = Planes(workspace, camera, to_planes(device, camera, image), mask_plane)
    actual, exact = apply_filter(planes, scalars).colors.get(), image.astype(np.float64)
    expected = ref.haar_filter(exact, taps, mask)
    yield compare_max("haar_forward", f"colors, {label}", actual[:, :height, :width], expected, 2e-6, floor=1.0)
    yield match("haar_forward", f"pixels outside the image, {label}", blank_image(camera, actual), 0.0)
    derivatives = filter_gradients(planes, scalars, to_planes(device, camera, gradient))()
    grad_taps = ref.haar_gradient(exact, gradient, taps, mask)
    grad_scalars = np.array([grad_taps[0] - grad_taps[1], grad_taps.sum()]) / np.sqrt(2)
    actual, size = np.array([*derivatives.values()]), float(np.sqrt(gradient.size))
    yield compare_max("haar_backward", f"gradients of the taps, {label}", actual, grad_scalars, Tol.SUM, floor=size)


@CHECKS.add("haar_forward", "haar_backward")
def haar(device: Device, rng: np.random.Generator) -> Results:
    for width, height in ((1, 1), (2, 2), (16, 5), (17, 33), (129, 66)):
        for fraction in (None, 0.6):
            yield from check_haar(device, rng, width, height, fraction, rng.normal(size=2).round(2))


def sobel_magnitude(image: NDArray[Any]) -> NDArray[Any]:
    """Return |Sobel| / 8 of the luminance of an image, [3, H, W], in float64."""
    luminance = np.tensordot([0.299, 0.587, 0.114], image.astype(np.float64), axes=1)
    across, down = (ndimage.sobel(luminance, axis=axis, mode="nearest") for axis in (1, 0))
    return np.hypot(across, down) / 8


@CHECKS.add("image_gradient", "hide_masked")
def texture(device: Device, rng: np.random.Generator) -> Results:
    for width, height in ((1, 1), (7, 5), (17, 17), (40, 30), (65, 3)):
        image = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
        mask = rng.random((height, width)) < 0.9
        camera, workspace, label = make_camera(device, width, height), Workspace(device), f"{width} x {height} px"
        workspace.array("texture", (camera.rows, camera.stride)).fill(9)
        expected = sobel_magnitude(image)
        for pixel_mask in (None, mask):
            mask_plane = None if pixel_mask is None else to_planes(device, camera, pixel_mask[None])
            actual = unmasked_gradient(workspace, camera, to_planes(device, camera, image), mask_plane).get()
            if pixel_mask is not None:
                expected = np.where(ndimage.minimum_filter(pixel_mask, 3, mode="nearest"), expected, -1)
            kernel = "image_gradient" if pixel_mask is None else "hide_masked"
            yield compare_max(kernel, f"texture, {label}", actual[:height, :width], expected, 1e-6, floor=1)
            yield match(kernel, f"texture outside the image, {label}", blank_image(camera, actual), 0.0)


SCALES = (1.0, 1e-2, 8.0)  # factors on differences; some put residuals outside of the histogram's range


def check_transient(
    device: Device, rng: np.random.Generator, width: int, height: int, scale: float, fraction: float | None
) -> Results:
    """Compare residuals, their histogram, and masks.  A `fraction` of the pixels is unmasked; None: all."""
    x, y = image_pair(rng, width, height)
    x = (y + np.float32(scale) * (x - y)).astype(np.float32)
    unmasked = np.ones((height, width), bool) if fraction is None else rng.random((height, width)) < fraction
    camera, workspace = make_camera(device, width, height), Workspace(device)
    for name in ("residuals", "counted pixels"):
        workspace.array(name, (1, camera.rows, camera.stride)).fill(7)
    mask = None if fraction is None else to_planes(device, camera, unmasked[None])
    planes = to_planes(device, camera, x), to_planes(device, camera, y)
    actual, wait_for_histogram = measure_residuals(workspace, camera, *planes, mask)
    label, values = f"{width} x {height} px", actual.get()[0, :height, :width]
    exact = ref.residuals(x.astype(np.float64), y.astype(np.float64))
    yield compare_max("measure_residuals", f"residuals, {label}", values[unmasked], exact[unmasked], 1e-6, floor=1e-6)
    excluded_pixels = actual.get()[0].copy()
    excluded_pixels[:height, :width][unmasked] = -1
    yield match("measure_residuals", f"masked pixels, {label}", excluded_pixels, -1.0)
    histogram = ref.residual_histogram(values[unmasked].astype(np.float64))
    yield match("measure_residuals", f"histogram, {label}", wait_for_histogram(), histogram)
    for quantile, reach in ((0.2, 1), (0.5, 1), (0.6, 3), (0.9, 2)):
        threshold = float(np.float32(np.quantile(values, quantile)))
        mask = mask_transients(workspace, camera, actual, threshold, reach).get()[0]
        expected = np.zeros_like(mask)
        expected[:height, :width] = ref.mask_transients(values, unmasked, threshold, reach)
        yield match("mask_transients", f"mask, {label}", mask, expected)


@CHECKS.add("measure_residuals", "mask_transients")
def transients(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        for scale in SCALES:
            yield from check_transient(device, rng, width, height, scale, None)
            yield from check_transient(device, rng, width, height, scale, 0.7)


# fusion.cl: depth images of views, at the grid points of blocks.

FUSION_MARGIN = 1e-3  # smallest distance of a value from a threshold, in px or truncations


def depth_image(rng: np.random.Generator, width: int, height: int) -> DepthImage:
    """Return a depth image of two surfaces, in which the depth of some pixels is unknown."""
    depth = np.where(rng.random((height, width)) < 0.3, 2.5, 4) + np.linspace(0, 1, width) ** 2
    depth += 0.3 * (rng.random((height, width)) < 0.1) + np.linspace(0, 0.5, height)[:, None]
    depth = ndimage.median_filter(depth, 3) * (rng.random((height, width)) < 0.95)
    color = rng.random((height, width, 3)).astype(np.float32)
    return DepthImage(random_case(rng, 1, width, height).view, depth.astype(np.float32), color)


@CHECKS.add("integrate_view", "count_free")
def fusion(device: Device, rng: np.random.Generator) -> Results:
    voxel, truncation = 0.0625, 0.5
    for width, height in ((1, 1), (17, 33), (40, 30)):
        image, label = depth_image(rng, width, height), f"{width} x {height} px"
        pose = image.view.world_to_camera.astype(np.float64)
        center = pose[:, :3].T @ (np.array([0, 0, 4]) - pose[:, 3])
        offsets = np.array([[0, 0, 0], [1, 0, 0], [0, 0, -1]])
        blocks = (np.floor(center / (voxel * SIDE)) + offsets).astype(np.int32)
        grid = np.indices((SIDE,) * 3).reshape(3, -1).T
        points = voxel * (blocks[:, None] * SIDE + grid).reshape(-1, 3).astype(np.float64)
        pixels = np.concatenate([image.color, image.depth[:, :, None]], axis=2).astype(np.float64)
        camera = Case({}, image.view).camera()
        sums, margin = ref.integrate_view(points, pixels, camera, truncation)
        is_safe = margin > FUSION_MARGIN
        yield count_true("integrate_view", f"points near a step, {label}", ~is_safe, limit=0.02 * len(points))
        actual = integrate(device, [image, image], blocks, voxel, truncation)[0].get()
        yield compare_max("integrate_view", f"sums, {label}", actual[:, is_safe], 2 * sums[:, is_safe], 1e-4, floor=1.0)
        free = ref.sees_free(points, pixels[:, :, 3], camera, voxel)
        views = count_free(device, [image, image], blocks, voxel).ravel()
        wrong = is_safe & (views != 2 * free)
        yield count_true("count_free", f"views, {label}", wrong, limit=1e-3 * len(points))
