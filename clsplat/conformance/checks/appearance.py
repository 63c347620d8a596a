"""Check bilateral grids, color matrices and camera responses: images, gradients, and updates of the tables."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Results, Tol, compare_max, match
from clsplat.conformance.checks.images import SIZES, blank_image, make_camera, to_planes
from clsplat.conformance.reference import appearance
from clsplat.conformance.reference.appearance import unclamped_grid_colors
from clsplat.opencl.device import Device
from clsplat.photos.appearance import IDENTITY, LUMINANCE
from clsplat.render.camera import CAMERA
from clsplat.render.workspace import Workspace
from clsplat.training.modules.bilateral_grid import BilateralGrid, GridState, row_length
from clsplat.training.modules.camera_response import respond, row_gradient
from clsplat.training.modules.exposure import color_gradients, transform_colors

CHECKS = Checks()
MARGIN = 1e-3  # distance from black, white and the grid's levels, where derivatives are one-sided
CASES = (  # width, height, nodes
    (1, 1, (4, 4, 4)),
    (17, 33, (4, 4, 4)),
    (257, 9, (3, 5, 2)),
    (33, 18, (16, 16, 8)),
    (40, 21, (1, 1, 1)),
    (40, 21, (1, 4, 3)),
    (21, 40, (4, 1, 16)),
)


def random_grids(device: Device, rng: np.random.Generator, nodes: tuple[int, ...], weight: float = 1.0) -> GridState:
    """Return random bilateral grids of three photographs."""
    grids = GridState(BilateralGrid(grid_shape=list(nodes), weight=weight), ("a", "b", "c"), device)
    grids.load({}, {"values": rng.normal(0, 0.2, grids.shape).astype(np.float32)})
    return grids


def photograph_grid(grids: GridState, values: NDArray[Any]) -> NDArray[Any]:
    """Reshape the values of one photograph's grid to [3, 4, nz, ny, nx], float64."""
    return values.reshape(3, 4, *grids.shape[2:]).astype(np.float64)


def image_for(rng: np.random.Generator, grid: NDArray[Any], width: int, height: int, channels: int) -> NDArray[Any]:
    """Return a random image with values below 0 and above 1, but no values within MARGIN of a threshold."""
    image = rng.uniform(-0.2, 1.4, (channels, height, width)).astype(np.float32)
    exact = image[:3].astype(np.float64)
    luminance = np.einsum("a,ahw->hw", LUMINANCE, exact)
    level = luminance * (grid.shape[2] - 1)
    is_near = np.abs(level - np.rint(level)) < MARGIN
    is_near |= (np.abs(luminance) < MARGIN) | (np.abs(luminance - 1) < MARGIN)
    is_near |= (np.abs(unclamped_grid_colors(exact, grid) - 1) < MARGIN).any(axis=0)
    image[:, is_near] = 0.1 / max(grid.shape[2] - 1, 1)
    return image


def check_grid(
    device: Device, rng: np.random.Generator, width: int, height: int, nodes: tuple[int, ...], channels: int = 3
) -> Results:
    """Compare an image transformed by a grid, and the gradients of the image and the grid."""
    label = f"{width} x {height} px, {' x '.join(map(str, nodes))} matrices"
    grids = random_grids(device, rng, nodes)
    grid = photograph_grid(grids, grids.tables()["values"][1])
    image = image_for(rng, grid, width, height, channels)
    gradient = rng.normal(size=image.shape).astype(np.float32)
    camera, workspace = make_camera(device, width, height), Workspace(device)
    for name in ("colored", "grad_colored"):
        workspace.array(name, (channels, camera.rows, camera.stride)).fill(np.nan)
    planes, grads = to_planes(device, camera, image), to_planes(device, camera, gradient)
    exact = image[:3].astype(np.float64)
    colors = grids.transform(workspace, camera, planes, 1).get()
    expected = ref.apply_color_grid(exact, grid)
    yield compare_max("color_grid_forward", f"colors, {label}", colors[:3, :height, :width], expected, 3e-6, floor=1.0)
    yield match("color_grid_forward", f"pixels outside the image, {label}", blank_image(camera, colors[:3]), 0.0)
    gradients = grids.differentiate(workspace, camera, planes, grads, 1)
    grad_image, grad_grid = (array.get() for array in gradients)
    expected_image, expected_grid = ref.color_grid_backward(exact, grid, gradient[:3].astype(np.float64))
    max_gradient = max(float(np.abs(expected_image).max()), 1.0)
    actual, kernel = grad_image[:3, :height, :width], "color_grid_backward"
    yield compare_max(kernel, f"gradient, {label}", actual, expected_image, 1e-5, floor=max_gradient)
    yield match(kernel, f"gradient outside the image, {label}", blank_image(camera, grad_image[:3]), 0.0)
    floor = max(float(np.sqrt(gradient.size)) / 8, 1.0)
    for kernel in ("color_grid_row_sums", "color_grid_gather"):
        actual = photograph_grid(grids, grad_grid)
        yield compare_max(kernel, f"gradient of the grid, {label}", actual, expected_grid, Tol.SUM, floor=floor)
    if channels > 3:
        yield match("color_grid_forward", f"fourth plane, {label}", colors[3], planes.get()[3])
        yield match("color_grid_backward", f"gradient of the fourth plane, {label}", grad_image[3], grads.get()[3])


def check_table(device: Device, rng: np.random.Generator, nodes: tuple[int, ...]) -> Results:
    """Compare the smoothness of a grid and the results of three updates; check that the other grids do not change."""
    label, weight = f"{' x '.join(map(str, nodes))} matrices", 0.7
    grids, workspace = random_grids(device, rng, nodes, weight), Workspace(device)
    expected = grids.tables()["values"].astype(np.float64).reshape(3, -1)
    moment1, moment2 = np.zeros((2, row_length(nodes)))
    grids.rate = rate = 0.01
    for step in range(1, 4):
        terms = grids.smoothness(workspace, 1)
        grad_smoothness = workspace.array("grid smoothness", row_length(nodes)).get()
        smoothness, slope = ref.grid_smoothness(photograph_grid(grids, expected[1]))
        actual, truth = np.array([terms.get().sum(dtype=np.float64)]), np.array([weight * smoothness])
        kernel = "color_grid_smoothness"
        yield compare_max(kernel, f"value, {label}", actual, truth, Tol.SUM, floor=1e-2)
        actual, truth = photograph_grid(grids, grad_smoothness), weight * slope
        max_gradient = max(float(np.abs(truth).max()), 1e-6)
        yield compare_max(kernel, f"derivatives, {label}", actual, truth, 2e-5, floor=max_gradient)
        gradient = rng.normal(0, 0.1, row_length(nodes)).astype(np.float32)
        grids.learn(workspace, 1, device.upload(gradient), step)
        total = gradient.astype(np.float64) + grad_smoothness
        expected[1], moment1, moment2 = ref.adam_step(expected[1], total, moment1, moment2, step, rate)
        new_grids = np.stack([photograph_grid(grids, values) for values in expected])
        expected = ref.center_grids(new_grids).reshape(expected.shape)
    tables = {name: table.reshape(3, -1) for name, table in grids.tables().items()}
    for kernel in ("color_grid_update", "color_grid_center"):
        yield compare_max(kernel, f"grids, {label}", tables["values"], expected, 2e-6, floor=1.0)
    for name, moment, bound in (("moment1", moment1, Tol.SUM), ("moment2", moment2, 3 * Tol.SUM)):
        floor = 0.1 * float(np.abs(moment).max())
        yield compare_max("color_grid_update", f"{name}, {label}", tables[name][1], moment, bound, floor=floor)
        yield match("color_grid_update", f"{name} of other photos, {label}", tables[name][[0, 2]], 0.0)


@CHECKS.add("color_grid_forward", "color_grid_backward", "color_grid_row_sums", "color_grid_gather")
def color_grids(device: Device, rng: np.random.Generator) -> Results:
    for width, height, nodes in CASES:
        yield from check_grid(device, rng, width, height, nodes)
    yield from check_grid(device, rng, 33, 18, (4, 4, 4), channels=4)


@CHECKS.add("color_grid_smoothness", "color_grid_update", "color_grid_center")
def color_grid_tables(device: Device, rng: np.random.Generator) -> Results:
    for nodes in ((4, 4, 4), (1, 1, 1), (5, 1, 3)):
        yield from check_table(device, rng, nodes)


def check_color(device: Device, rng: np.random.Generator, width: int, height: int, channels: int = 3) -> Results:
    """Compare an image with values above 1, transformed by a color matrix, and the gradients of both."""
    label = f"{width} x {height} px"
    matrix = (IDENTITY + rng.normal(0, 0.2, (3, 4))).astype(np.float32).astype(np.float64)
    image = rng.uniform(-0.2, 1.6, (channels, height, width)).astype(np.float32)
    near_white = np.abs(np.einsum("ab,bhw->ahw", matrix[:, :3], image[:3]) + matrix[:, 3, None, None] - 1).min(axis=0)
    image[:, near_white < MARGIN] = 0
    gradient = rng.normal(size=image.shape).astype(np.float32)
    camera, workspace = make_camera(device, width, height), Workspace(device)
    for name in ("colored", "grad_colored"):
        workspace.array(name, (channels, camera.rows, camera.stride)).fill(np.nan)
    planes = to_planes(device, camera, image)
    actual = transform_colors(workspace, camera, planes, matrix).get()
    exact = image[:3].astype(np.float64)
    expected = ref.apply_color_matrix(exact, matrix)
    yield compare_max("colors_forward", f"colors, {label}", actual[:3, :height, :width], expected, 2e-6, floor=1.0)
    yield match("colors_forward", f"pixels outside the image, {label}", blank_image(camera, actual), 0.0)
    grads = to_planes(device, camera, gradient)
    grad_image, wait_for_matrix = color_gradients(workspace, camera, planes, matrix, grads)
    expected, grad_matrix = ref.color_matrix_backward(exact, matrix, gradient[:3].astype(np.float64))
    grad = grad_image.get()
    yield compare_max("colors_backward", f"gradient, {label}", grad[:3, :height, :width], expected, 2e-6, floor=1.0)
    yield match("colors_backward", f"gradient outside the image, {label}", blank_image(camera, grad), 0.0)
    floor, actual_matrix = float(np.sqrt(gradient.size)), wait_for_matrix()
    yield compare_max(
        "colors_backward", f"gradient of the matrix, {label}", actual_matrix, grad_matrix, Tol.SUM, floor=floor
    )
    if channels > 3:
        yield match("colors_forward", f"fourth plane, {label}", actual[3], planes.get()[3])
        yield match("colors_backward", f"gradient of the fourth plane, {label}", grad[3], grads.get()[3])


@CHECKS.add("colors_forward", "colors_backward")
def colors(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        yield from check_color(device, rng, width, height)
    yield from check_color(device, rng, 33, 18, channels=4)


def check_response(device: Device, rng: np.random.Generator, width: int, height: int, channels: int = 3) -> Results:
    """Compare an image with values outside [0, 1], transformed by a camera response, and the gradients of both."""
    label, kernel = f"{width} x {height} px", "camera_response"
    row = np.concatenate([rng.normal(0, 0.1, 5), rng.normal(0, 0.4, 12)])
    image = rng.uniform(-0.3, 1.5, (channels, height, width)).astype(np.float32)
    gradient = rng.normal(size=image.shape).astype(np.float32)
    values = np.zeros((), CAMERA)
    values["cx"], values["cy"] = center = 0.625 * width, 0.375 * height
    camera, workspace = replace(make_camera(device, width, height), values=values), Workspace(device)
    for name in ("response", "grad_response"):
        workspace.array(name, (channels, camera.rows, camera.stride)).fill(np.nan)
    planes, grads = to_planes(device, camera, image), to_planes(device, camera, gradient)
    colors = respond(workspace, camera, planes, row).get()
    grad_image = respond(workspace, camera, planes, row, grads).get()
    sums = workspace.array("response sums", (20, camera.rows)).get()
    exact, upstream = image[:3].astype(np.float64), gradient[:3].astype(np.float64)
    expected = appearance.apply_response(exact, row, center)
    yield compare_max(kernel, f"colors, {label}", colors[:3, :height, :width], expected, 3e-6, floor=1.0)
    yield match(kernel, f"pixels outside the image, {label}", blank_image(camera, colors[:3]), 0.0)
    expected, grad_row = appearance.apply_response_backward(exact, row, center, upstream)
    max_gradient = max(float(np.abs(expected).max()), 1.0)
    yield compare_max(kernel, f"gradient, {label}", grad_image[:3, :height, :width], expected, 1e-5, floor=max_gradient)
    yield match(kernel, f"gradient outside the image, {label}", blank_image(camera, grad_image[:3]), 0.0)
    floor = float(np.sqrt(gradient.size))
    actual = row_gradient(row, sums)
    yield compare_max(kernel, f"gradient of the parameters, {label}", actual, grad_row, Tol.SUM, floor=floor)
    if channels > 3:
        yield match(kernel, f"fourth plane, {label}", colors[3], planes.get()[3])
        yield match(kernel, f"gradient of the fourth plane, {label}", grad_image[3], grads.get()[3])


@CHECKS.add("camera_response")
def responses(device: Device, rng: np.random.Generator) -> Results:
    for width, height in SIZES:
        yield from check_response(device, rng, width, height)
    yield from check_response(device, rng, 33, 18, channels=4)
