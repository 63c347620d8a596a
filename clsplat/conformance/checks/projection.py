"""Check projection: splat records, gradients, depth, the 3D filter, and gradients of the camera pose."""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Deviation, Results, Tol, compare, compare_max, count_true, match
from clsplat.conformance.scenes import (
    Case,
    add_world_filter,
    gradients_to_sums,
    needle_case,
    random_case,
    sums_to_gradients,
)
from clsplat.gaussians.gaussians import HIDDEN_VIEWS, hide
from clsplat.opencl.device import Device
from clsplat.render.filters import FilterViews, Smoothing
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer, pose_gradient

CHECKS = Checks()
CULLED = 0xFFFFFFFF  # depth key
COUNTS = (1, 15, 17, 65)
FILTERS = ((0.3, 1.0), (0.1, 1.0), (0.0, 0.0))  # variance, compensate
ASPECT_RATIOS = 30, 70, 150  # of long splats on the screen
LONG_FILTERS: dict[str, dict[str, float]] = {
    "dilation": {"variance": 0.3},
    "ewa": {"variance": 0.3, "compensate": 1.0},
    "mip": {"variance": 0.1, "compensate": 1.0},
    "box": {"variance": 0.0, "pixel_box": 1.0},
}
LONG_GRADIENT = 1e-3  # largest error in the gradient of a long splat, relative to the largest gradient


def project_records(device: Device, case: Case) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return records, [N, RECORD], depth keys, [N], and radii, [N], from the kernel."""
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    keys = rasterizer.workspace.array("depth_key", len(case.parameters["means"]), np.uint32).get()
    return frame.splats.get(), keys, frame.radius.get()[: len(keys)]


def check_record(device: Device, case: Case, label: str) -> Results:
    """Compare the splat records of a scene with the reference."""
    kernel = "project_forward"
    records, keys, radius = project_records(device, case)
    truth, (width, height) = case.project(), case.size
    # the kernel also culls splats that reach no pixel of the image: such splats must be outside the image or too faint
    is_rendered = records[:, 5] > 0
    x, y = truth.mean2d.T
    may_be_culled = (x < 0) | (y < 0) | (x > width) | (y > height) | (truth.opacity < 1.001 / 255)
    yield count_true(
        kernel,
        f"visibility, {label}",
        (is_rendered & ~truth.visible) | (truth.visible & ~is_rendered & ~may_be_culled),
    )
    is_rendered &= truth.visible
    record = records[is_rendered]
    yield compare_max(kernel, f"means, {label}", record[:, :2], truth.mean2d[is_rendered], Tol.PROJECTION, floor=50)
    conic = record_covariances(record) if case.pixel_box else record[:, 2:5]
    size = np.maximum(np.linalg.norm(truth.conic[is_rendered], axis=1), 1e-30)
    error = np.linalg.norm(conic - truth.conic[is_rendered], axis=1) / size
    yield Deviation(kernel, f"conics, {label}", float(error.max(initial=0)), Tol.CONIC)
    yield compare_max(kernel, f"opacities, {label}", record[:, 5], truth.opacity[is_rendered], Tol.PROJECTION)
    yield compare_max(kernel, f"colors, {label}", record[:, 6:9], truth.color[is_rendered], Tol.PROJECTION, floor=1)
    yield compare_max(
        kernel, f"depths, {label}", keys[is_rendered].view(np.float32), truth.depth[is_rendered], Tol.DEPTH
    )
    if not case.pixel_box:
        power_min = -np.log(255 * truth.opacity[is_rendered])
        yield compare_max(kernel, f"reaches, {label}", record[:, 13], power_min, Tol.PROJECTION, floor=1)
    is_culled = records[:, 5] <= 0
    yield count_true(
        kernel, f"culled splats, {label}", (keys[is_culled] != CULLED) | (records[is_culled] != 0).any(axis=1)
    )
    # ceil() may jump by a pixel where the radius is close to an integer
    yield count_true(kernel, f"radii, {label}", ~(np.abs(radius - truth.radius) <= 1))
    yield count_true(kernel, f"exact radii, {label}", radius != truth.radius, limit=0.02 * len(radius))
    yield count_true(kernel, f"extents, {label}", _wrong_extents(record, truth, is_rendered))


def record_covariances(record: NDArray[Any]) -> NDArray[Any]:
    """Return covariances, [N, 3], from the fields of records for the box filter."""
    k, s, t, is_swapped = (record[:, field].astype(np.float64) for field in (2, 3, 4, 13))
    xx, xy, yy = t**2 + k**2 * s**2, k * s**2, s**2
    return np.stack([np.where(is_swapped > 0, yy, xx), xy, np.where(is_swapped > 0, xx, yy)], axis=1)


def _wrong_extents(record: NDArray[Any], truth: ref.Splats, is_rendered: NDArray[Any]) -> NDArray[Any]:
    """Return a mask of the extents that exclude pixels with an alpha of 1/255 or more, or that are much too large."""
    reach2 = 2 * np.log(255 * truth.opacity[is_rendered])
    a, b, c = truth.conic[is_rendered].T
    half_x, half_y = np.sqrt(reach2 * c / (a * c - b * b)), np.sqrt(reach2 * a / (a * c - b * b))
    if truth.pixel_box:  # from the covariance, half a pixel wider on each side
        half_x, half_y = 0.5 + np.sqrt(reach2 * a), 0.5 + np.sqrt(reach2 * c)
    is_correct = np.ones(len(record), bool)
    for low, high, center, half in ((11, 12, 0, half_x), (9, 10, 1, half_y)):
        mean = truth.mean2d[is_rendered, center]
        is_correct &= (record[:, high] >= mean + half - 1e-3) & (record[:, low] <= mean - half + 1e-3)
        is_correct &= record[:, high] - record[:, low] <= 2.4 * half + (3 if truth.pixel_box else 1)
    return ~is_correct


def check_gradient(device: Device, case: Case, rng: np.random.Generator, label: str) -> Results:
    """Compare the gradients of the parameters that the kernel and the reference compute from the same pixel sums."""
    model, camera = case.model(device), case.device_camera(device)
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(model, camera, device.zeros(3))
    gaussians, truth = model.gaussians, case.project()
    is_rendered = frame.splats.get()[:, 5] > 0
    pixel_sums = np.zeros((PIXEL_SUMS, gaussians.capacity), np.float32)
    pixel_sums[:, : gaussians.count] = rng.normal(size=(PIXEL_SUMS, gaussians.count)) * is_rendered
    gradients = rasterizer.gradients(model, frame, device.upload(pixel_sums))
    expected = expected_gradients(case, truth, pixel_sums[:, : gaussians.count].astype(np.float64).T)
    for name, array in gradients.arrays.items():
        value = array.get()[:, : gaussians.count].T
        yield compare("project_backward", f"gradients of {name}, {label}", value, expected[name], Tol.CONIC)
    value = gradients.mean2d.get()[:, : gaussians.count].T
    yield compare("project_backward", f"gradients of projected means, {label}", value, expected["mean2d"], Tol.CONIC)


def check_long_splats(device: Device, case: Case, rng: np.random.Generator, label: str) -> Results:
    """Compare the gradients of the loss Σ weights · image for each Gaussian, relative to its largest gradient."""
    model, rasterizer, (width, height) = case.model(device), Rasterizer(device, "radix"), case.size
    frame, truth = rasterizer.forward(model, case.device_camera(device), device.zeros(3)), case.project()
    weights, gaussians = scipy.ndimage.gaussian_filter(rng.normal(size=(3, height, width)), (0, 2, 2)), model.gaussians
    exact = ref.blend_backward(truth, width, height, np.zeros(3), weights)
    sums = np.zeros((PIXEL_SUMS, gaussians.capacity), np.float32)
    sums[:, : gaussians.count] = gradients_to_sums(truth, exact).T
    gradients = rasterizer.gradients(model, frame, device.upload(sums))
    expected = expected_gradients(case, truth, sums[:, : gaussians.count].astype(np.float64).T)
    for name in ("means", "quats", "log_scales"):
        value = gradients.arrays[name].get()[:, : gaussians.count].T
        error = np.abs(value - expected[name]).max(axis=1) / np.abs(expected[name]).max()
        yield Deviation("project_backward", f"the worst gradient of {name}, {label}", float(error.max()), LONG_GRADIENT)
        median, median_label = float(np.median(error)), f"the median gradient of {name}, {label}"
        yield Deviation("project_backward", median_label, median, LONG_GRADIENT / 10)


def expected_gradients(case: Case, truth: ref.Splats, sums: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Compute the gradients of all parameters and of the projected means from sums over pixels, [N, PIXEL_SUMS]."""
    grad_mean2d, grad_conic = sums_to_gradients(truth, sums)
    grad_opacity = np.where(truth.visible, sums[:, 0] / np.where(truth.visible, truth.opacity, 1), 0)
    upstream = grad_mean2d, grad_conic, grad_opacity, sums[:, 6:9]
    gaussians, camera = case.gaussians(), case.camera()
    expected = ref.project_backward(gaussians, camera, case.degree, case.variance, case.compensate, truth, *upstream)
    sh = expected.pop("sh")
    return {
        **expected,
        "logit_opacity": expected["logit_opacity"][:, None],
        "sh_base": sh[:, 0],
        "sh_rest": sh[:, 1:].reshape(len(sh), -1),
        "mean2d": grad_mean2d,
    }


def undrawable_case(rng: np.random.Generator) -> Case:
    """Return a case of 40 Gaussians, the first nine of them behind the camera, huge, faint, or NaN."""
    case = random_case(rng, 40)
    p, pose = case.parameters, case.view.world_to_camera
    p["means"][0] = (np.array([0, 0, -3]) - pose[:, 3]) @ pose[:, :3]
    p["means"][1, 1] = np.nan
    p["means"][2] = 1e30
    p["quats"][3] = 0
    p["quats"][4, 2] = np.nan
    p["log_scales"][5] = np.nan
    p["log_scales"][6] = 200  # clamped, covers everything
    p["logit_opacity"][7] = -9
    p["logit_opacity"][8] = np.nan
    return case


def wide_angle_case(rng: np.random.Generator) -> Case:
    """Return a case of Gaussians spread over a field of view of 170 degrees."""
    case = random_case(rng, 40)
    camera, pose, (width, height) = case.view.camera, case.view.world_to_camera, case.size
    camera = replace(camera, fx=0.045 * width, fy=0.045 * width)
    depth = rng.uniform(0.3, 1, 40)
    rays = rng.uniform(-0.5, 0.5, (40, 2)) * [width / camera.fx, height / camera.fy]
    case.parameters["means"][:] = (np.column_stack([rays * depth[:, None], depth]) - pose[:, 3]) @ pose[:, :3]
    case.parameters["log_scales"][:] = np.log(3 / camera.fx * depth[:, None]) + rng.normal(-0.3, 0.6, (40, 3))
    return replace(case, view=replace(case.view, camera=camera))


def clamped_case(rng: np.random.Generator) -> Case:
    """Return a case of large Gaussians with rays beyond the limits at which the linear projection is clamped."""
    case = random_case(rng, 30)
    depth, slope = rng.uniform(1, 2, 30), rng.choice([-1, 1], 30) * rng.uniform(0.9, 1.3, 30)
    camera_points = np.stack([slope * depth, 0.2 * depth, depth], axis=1)
    rotation, translation = case.view.world_to_camera[:, :3], case.view.world_to_camera[:, 3]
    case.parameters["means"][:] = (camera_points - translation) @ rotation
    case.parameters["log_scales"][:] = np.log(0.6) + rng.normal(0, 0.2, (30, 3))
    return case


@CHECKS.add("project_forward")
def projection(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield from check_record(device, random_case(rng, count), f"{count} Gaussians")
    for degree in range(3):
        yield from check_record(device, random_case(rng, 20, degree=degree), f"harmonics of degree {degree}")
    for variance, compensate in FILTERS:
        case = add_world_filter(random_case(rng, 30, variance=variance, compensate=compensate), rng)
        yield from check_record(device, case, f"filters of {variance:g} px², compensate {compensate:g}")


@CHECKS.add("project_forward")
def projection_of_what_cannot_be_drawn(device: Device, rng: np.random.Generator) -> Results:
    records, keys, radius = project_records(device, undrawable_case(rng))
    culled_rows = [0, 1, 2, 3, 4, 5, 7, 8]
    yield match(
        "project_forward", "records of Gaussians behind the camera, too faint, or not finite", records[culled_rows], 0.0
    )
    yield match(
        "project_forward", "depths of Gaussians behind the camera, too faint, or not finite", keys[culled_rows], CULLED
    )
    yield match("project_forward", "radii of Gaussians behind the camera or not finite", radius[:6], 0.0)
    yield count_true("project_forward", "records that are not numbers", np.isnan(records))


def check_hidden(device: Device, case: Case, rng: np.random.Generator, views: int) -> Results:
    """Hide Gaussians in training views; compare the image of each view with an image without these Gaussians."""
    model, camera, count = case.model(device), case.device_camera(device), len(case.parameters["means"])
    hidden_masks = rng.random((views, count)) < 0.5
    hide(model.gaussians, hidden_masks)
    rasterizer, background = Rasterizer(device, "radix"), device.upload(np.full(3, 0.25, np.float32))
    for view in sorted({0, min(HIDDEN_VIEWS, views) - 1, views - 1}):
        label = f"hidden Gaussians of {count}, view {view} of {views}"
        frame = rasterizer.forward(model, replace(camera, view_index=view), background)
        actual, hidden = frame.image.get().copy(), hidden_masks[view]
        yield match("project_forward", f"records of {label}", frame.splats.get()[hidden], 0.0)
        yield match("project_forward", f"depths of {label}", frame.depth_key.get()[:count][hidden], CULLED)
        yield match("project_forward", f"radii of {label}", frame.radius.get()[:count][hidden], 0.0)
        visible_case = Case({name: values[~hidden] for name, values in case.parameters.items()}, case.view)
        expected = rasterizer.forward(visible_case.model(device), camera, background).image.get()
        yield match("project_forward", f"image without {label}", actual, expected)


@CHECKS.add("project_forward")
def gaussians_hidden_from_views(device: Device, rng: np.random.Generator) -> Results:
    for count, views in ((17, 2), (65, HIDDEN_VIEWS + 1)):
        yield from check_hidden(device, random_case(rng, count), rng, views)


@CHECKS.add("project_backward")
def gradients_of_the_projection(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield from check_gradient(device, random_case(rng, count), rng, f"{count} Gaussians")
    for degree in range(3):
        case = random_case(rng, 20, degree=degree)
        yield from check_gradient(device, case, rng, f"harmonics of degree {degree}")
    for variance, compensate in FILTERS:
        case = add_world_filter(random_case(rng, 30, variance=variance, compensate=compensate), rng)
        yield from check_gradient(device, case, rng, f"filters of {variance:g} px², compensate {compensate:g}")
    yield from check_gradient(device, clamped_case(rng), rng, "rays beyond the image")


@CHECKS.add("project_backward")
def gradients_of_needles(device: Device, rng: np.random.Generator) -> Results:
    """Compare the gradients of long splats in a blended image.  Unstable formulas lose most digits for such splats."""
    for aspect in ASPECT_RATIOS:
        for name, settings in LONG_FILTERS.items():
            case = needle_case(rng, 12, aspect, **settings)
            yield from check_long_splats(device, case, rng, f"splats {aspect} times as long as wide, filter {name}")
    yield from check_long_splats(device, wide_angle_case(rng), rng, "a view of 170 degrees")


@CHECKS.add("sampling_interval", "filter_variance")
def world_filter(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        case = random_case(rng, count)
        case.parameters["means"][::3] *= 4  # invisible to some cameras, or to all
        views = []
        for i in range(5):
            pose = case.view.world_to_camera.astype(np.float32).astype(np.float64)
            pose[:, 3] += np.float32(rng.normal(0, 0.8, 3))
            camera = replace(case.view.camera, fx=float(rng.uniform(20, 60)))
            views.append(replace(case.view, name=f"view{i}", camera=camera, world_to_camera=pose))
        gaussians = case.model(device).gaussians
        Smoothing(variance=0.2).refresh(gaussians, FilterViews(device, views), near=0.2)
        cameras = [replace(case, view=view).camera() for view in views]
        means = case.parameters["means"].astype(np.float64)
        interval = ref.sampling_interval(means, cameras, [view.camera.fx for view in views])
        actual = gaussians.get("filter_variance")[:, 0]
        yield compare_max("filter_variance", f"variances, {count} Gaussians", actual, 0.2 * interval**2, Tol.SUM)


@CHECKS.add("paint_depth")
def depth(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        case = random_case(rng, count)
        frame = Rasterizer(device, "radix").forward(
            case.model(device), case.device_camera(device), device.zeros(3), "depth"
        )
        pose = case.camera().world_to_camera
        z = case.parameters["means"].astype(np.float64) @ pose[2, :3] + pose[2, 3]
        colors = frame.splats.get()[:, 6:9]
        expected = np.stack([z, np.ones(count), np.zeros(count)], axis=1)
        yield compare_max("paint_depth", f"depths, {count} Gaussians", colors, expected, Tol.DEPTH, floor=1)


# poses.cl: gradients of the pose and the focal length of a camera.


def check_pose(device: Device, case: Case, rng: np.random.Generator, label: str) -> Results:
    """Compare the gradients of pose and focal length that kernel and reference compute from the same pixel sums."""
    model, camera, rasterizer = case.model(device), case.device_camera(device), Rasterizer(device, "radix")
    frame, count = rasterizer.forward(model, camera, device.zeros(3)), model.gaussians.count
    pixel_sums = np.full((PIXEL_SUMS, model.gaussians.capacity), np.nan, np.float32)
    is_rendered = frame.splats.get()[:, 5] > 0
    pixel_sums[:, :count] = rng.normal(size=(PIXEL_SUMS, count)) * is_rendered
    actual = pose_gradient(rasterizer.workspace, model, frame, device.upload(pixel_sums))()
    sums, truth = pixel_sums[:, :count].astype(np.float64).T, case.project()
    grad_mean2d, grad_conic = sums_to_gradients(truth, sums)
    grad_opacity = np.where(truth.visible, sums[:, 0] / np.where(truth.visible, truth.opacity, 1), 0)
    upstream = grad_mean2d, grad_conic, grad_opacity, sums[:, 6:9]
    settings = case.degree, case.variance, case.compensate
    expected = ref.pose_gradient(case.gaussians(), case.camera(), *settings, truth, *upstream)
    rotation = case.camera().rotation
    values = {"translation": rotation @ actual[:3], "rotation": rotation @ actual[3:6], "focal length": actual[6:]}
    for (name, value), exact in zip(values.items(), expected, strict=True):
        yield compare("pose_gradient", f"gradient of the {name}, {label}", value[None], exact[None], Tol.CONIC)


@CHECKS.add("pose_gradient")
def poses(device: Device, rng: np.random.Generator) -> Results:
    for count in (1, 15, 17, 65, 600):
        yield from check_pose(device, random_case(rng, count), rng, f"{count} Gaussians")
    for degree in range(3):
        yield from check_pose(device, random_case(rng, 20, degree=degree), rng, f"harmonics of degree {degree}")
    for variance, compensate in ((0.1, 1.0), (0.0, 0.0)):
        case = add_world_filter(random_case(rng, 30, variance=variance, compensate=compensate), rng)
        yield from check_pose(device, case, rng, f"filters of {variance:g} px², compensate {compensate:g}")
    yield from check_pose(device, clamped_case(rng), rng, "rays beyond the limits")
    case = replace(random_case(rng, 30), variance=0.0, pixel_box=1.0)
    yield from check_pose(device, case, rng, "the box filter")
