"""Check the environment map of the sky: images, gradients, the loss of Gaussians that cover it, and updates."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Results, Tol, compare, compare_max, match
from clsplat.conformance.checks.images import blank_image, to_planes
from clsplat.conformance.scenes import Case, random_case
from clsplat.gaussians.sky import DeviceSky
from clsplat.opencl.device import Array, Device
from clsplat.render.camera import DeviceCamera
from clsplat.render.sky import Skies
from clsplat.render.workspace import Workspace

CHECKS = Checks()
SIZES = ((1, 1, 8), (17, 33, 8), (65, 40, 13), (257, 5, 24))  # width, height, texels per side
WEIGHT = 2e-6  # bound on the error of a texel's weight; its position is a difference of values up to 512


def wide_case(rng: np.random.Generator, width: int, height: int) -> Case:
    """Return a case whose camera has a wide lens and looks in a random direction."""
    case = random_case(rng, 1, width, height)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.column_stack([rotation * np.linalg.det(rotation), case.view.world_to_camera[:, 3]])
    camera = replace(case.view.camera, fx=0.25 * width, fy=0.3 * width)
    return replace(case, view=replace(case.view, camera=camera, world_to_camera=pose))


class SkyView:
    """A camera, a random environment map, and a random transmittance of each pixel."""

    def __init__(self, device: Device, rng: np.random.Generator, width: int, height: int, side: int) -> None:
        case = wide_case(rng, width, height)
        self.camera: DeviceCamera = case.device_camera(device)
        self.directions = ref.rays(case.camera(), width, height)
        self.texels = rng.random((side, side, 3)).astype(np.float32)
        self.sky = DeviceSky(device.upload(flatten_map(self.texels)), side)
        self.free_mask = rng.random((side, side)) < 0.95  # texels that are trained
        self.free = device.upload(self.free_mask.reshape(1, -1).astype(np.float32))
        self.magnitude = rng.random((height, width)).astype(np.float32)  # of the transmittance
        self.transmittance = self.planes(np.where(rng.random(self.magnitude.shape) < 0.5, -1, 1) * self.magnitude[None])
        self.skies = Skies(device, Workspace(device))

    def planes(self, image: NDArray[Any]) -> Array:
        return to_planes(self.camera.array.device, self.camera, np.asarray(image, np.float32))

    def crop(self, planes: NDArray[Any]) -> NDArray[Any]:
        return planes[..., : self.camera.height, : self.camera.width]


def flatten_map(texels: NDArray[Any]) -> NDArray[np.float32]:
    """Reshape [side, side, C] to [C, side * side]."""
    return np.ascontiguousarray(texels.reshape(-1, texels.shape[2]).T, np.float32)


def check_sky(device: Device, rng: np.random.Generator, width: int, height: int, side: int) -> Results:
    """Compare an image with sky and the gradient of the map.  Saturated pixels have a negative transmittance."""
    view, label = SkyView(device, rng, width, height, side), f"{width} x {height} px, {side} texels per side"
    image, gradient = rng.random((3, height, width)), rng.normal(size=(3, height, width)).astype(np.float32)
    planes = view.planes(image)
    view.skies.paint(view.sky, view.camera, planes, view.transmittance)
    sky_colors = ref.sky_image(view.texels.astype(np.float64), view.directions)
    expected, actual = image.astype(np.float32) + view.magnitude * sky_colors, planes.get()
    yield compare_max("sky_forward", f"image, {label}", view.crop(actual), expected, 5 * WEIGHT, floor=1.0)
    yield match("sky_forward", f"pixels outside the image, {label}", blank_image(view.camera, actual), 0.0)
    grad_texels = view.skies.grad_texels(view.sky, view.camera, view.transmittance, view.planes(gradient))
    transmittance = view.magnitude.astype(np.float64)
    expected = ref.sky_gradient(side, view.directions, transmittance, gradient.astype(np.float64)).reshape(-1, 3)
    visible = view.skies.runs(view.camera, side).texels.get()
    yield compare("sky_backward", f"derivatives, {label}", grad_texels.get().T, expected[visible], Tol.SUM)
    yield compare("sky_gather", f"derivatives by texels, {label}", grad_texels.get().T, expected[visible], Tol.SUM)
    yield match("sky_gather", f"texels outside the view, {label}", np.delete(expected, visible, axis=0), 0.0)


def check_cover(device: Device, rng: np.random.Generator, width: int, height: int, side: int) -> Results:
    """Compare the loss of Gaussians that cover the sky.  No pixel is close to the threshold on color differences."""
    view, label, difference, weight = SkyView(device, rng, width, height, side), f"{width} x {height} px", 0.02, 0.3
    sky = ref.sky_image(view.texels.astype(np.float64), view.directions)
    distance = np.where(rng.random((height, width)) < 0.3, 2.0, 0.4) * difference
    photograph = (sky + distance * np.where(rng.random(sky.shape) < 0.5, -1, 1)).astype(np.float32)
    scale = weight / (width * height)
    behind, sums = view.skies.coverage_loss(
        view.sky, view.free, view.camera, view.planes(photograph), view.transmittance, difference, scale
    )
    has_fixed_texel = ref.sky_image(1.0 - view.free_mask[..., None], view.directions)[0] > 0
    is_sky, actual = ref.sky_mask(sky, np.where(has_fixed_texel, 9, photograph), difference), behind.get()
    loss, grad_transmittance = ref.sky_cover(is_sky, view.magnitude.astype(np.float64), weight)
    for kernel in ("sky_matches", "sky_cover"):
        expected = view.magnitude * grad_transmittance
        yield compare_max(kernel, f"T dL/dT, {label}", view.crop(actual), expected, WEIGHT, floor=scale)
    yield match("sky_cover", f"T dL/dT outside the image, {label}", blank_image(view.camera, actual[None]), 0.0)
    value = np.array([scale * sums.get().sum(dtype=np.float64)])
    yield compare_max("sky_cover", f"loss, {label}", value, np.array([loss]), Tol.SUM, floor=0.1)


@CHECKS.add("sky_forward", "sky_backward", "sky_gather")
def sky(device: Device, rng: np.random.Generator) -> Results:
    for width, height, side in SIZES:
        yield from check_sky(device, rng, width, height, side)


@CHECKS.add("sky_matches", "sky_cover")
def cover_of_the_sky(device: Device, rng: np.random.Generator) -> Results:
    for width, height, side in SIZES:
        yield from check_cover(device, rng, width, height, side)


@CHECKS.add("sky_update")
def adam_of_the_sky(device: Device, rng: np.random.Generator) -> Results:
    """Compare three Adam updates, and check that texels outside the view do not change."""
    side = 16
    view, texels = SkyView(device, rng, 9, 7, side), side**2
    visible = view.skies.runs(view.camera, side).texels.get()
    moments = {name: device.zeros((width, texels)) for name, width in (("moment1", 3), ("moment2", 3), ("biases", 2))}
    moments["free"], is_free = view.free, view.free_mask.ravel()[visible]
    expected = flatten_map(view.texels)[:, visible].astype(np.float64)
    moment1, moment2 = np.zeros_like(expected), np.zeros_like(expected)
    initial, size = view.sky.texels.get(), 3 * 9 * 7
    for step in (1, 2, 3):
        gradient = (rng.normal(size=expected.shape) / size).astype(np.float32)
        view.skies.update(view.sky, view.camera, device.upload(gradient), moments, 0.01)
        total = size * gradient.astype(np.float64)
        new_values, moment1, moment2 = ref.adam_step(expected, total, moment1, moment2, step, 0.01, epsilon=1.0)
        expected = np.where(is_free, new_values, expected)
    actual = view.sky.texels.get()
    yield compare_max("sky_update", "colors of texels", actual[:, visible], expected, 1e-6, floor=1.0)
    for name, moment in (("moment1", moment1), ("moment2", moment2)):
        yield compare_max("sky_update", f"{name} of texels", moments[name].get()[:, visible], moment, 1e-5, floor=0.1)
    hidden = np.setdiff1d(np.arange(texels), visible)
    yield match("sky_update", "texels outside the view", actual[:, hidden], initial[:, hidden])
