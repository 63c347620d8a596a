"""Check motion: the Gaussians at a time, the gradient of their motion, the update of the motion, and penalties."""

from dataclasses import replace

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Results, Tol, compare, compare_max, count_true, match
from clsplat.conformance.scenes import Case, random_case
from clsplat.formats.splats import MOTION, STATIC_LOG_DURATION, WIDTHS, motion_fields, motion_width
from clsplat.gaussians.structs import GaussianGradients, moment_tables
from clsplat.opencl.device import Device
from clsplat.render.motion import backpropagate_motion, evaluate_motion
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training.adam import Adam
from clsplat.training.motion import MotionRates, update_motion

CHECKS = Checks()
COUNTS = (1, 15, 17, 65)
TIME = 0.375  # exact in float32
EXTENT = 2.0


def moving_case(rng: np.random.Generator, count: int, width: int = 5) -> Case:
    """Return a case of moving Gaussians: a tenth is absent at TIME, and another tenth is always present."""
    case, fields = random_case(rng, count), motion_fields(width)
    motion = rng.normal(0, 0.3, (count, width))
    center, duration = rng.uniform(0, 1, count), rng.normal(-1, 0.5, count)
    distance = np.abs(TIME - center) / np.exp(duration)
    duration[(distance > 3) & (distance < 3.7)] += 0.5  # Gaussians are visible up to a distance of 3.33
    center[::10], duration[::10] = 0.875, -2.5
    duration[5::10] = STATIC_LOG_DURATION
    motion[:, fields["time_center"]], motion[:, fields["log_duration"]] = center[:, None], duration[:, None]
    parameters = {**case.parameters, MOTION: motion.astype(np.float32)}
    return replace(case, parameters=parameters, view=replace(case.view, time=TIME))


def check_motion_at_time(device: Device, rng: np.random.Generator, count: int, width: int) -> Results:
    """Compare the tables at TIME, and the gradients of the motion."""
    case, (degree, has_rotation) = moving_case(rng, count, width), WIDTHS[width]
    model, camera, label = case.model(device), case.device_camera(device), f"{count} Gaussians, {width} columns"
    p = {name: table.astype(np.float64) for name, table in case.parameters.items()}
    logit = p["logit_opacity"][:, 0]
    actual_gaussians = evaluate_motion(Workspace(device), model, camera).gaussians
    means, quats, logits = ref.move_gaussians(p[MOTION], p["means"], p["quats"], logit, TIME, degree, has_rotation)
    is_present = np.isfinite(means).all(axis=1)
    actual = actual_gaussians.get("means")
    yield count_true("move_forward", f"presence, {label}", np.isfinite(actual).all(axis=1) != is_present)
    yield compare_max("move_forward", f"means, {label}", actual[is_present], means[is_present], 1e-6, floor=1.0)
    actual = actual_gaussians.get("logit_opacity")[is_present, 0]
    yield compare_max("move_forward", f"logits, {label}", actual, logits[is_present], 1e-5, 1.0)
    yield compare_max("turn_forward", f"quaternions, {label}", actual_gaussians.get("quats"), quats, 1e-6, floor=1.0)

    gradients = GaussianGradients(model.gaussians)
    grads = {name: rng.normal(size=p[name].shape).astype(np.float32) for name in ("means", "quats", "logit_opacity")}
    for name, values in grads.items():
        values[~is_present] = 0
        planes = np.zeros(gradients[name].shape, np.float32)
        planes[:, :count] = values.T
        gradients[name].set(planes)
    backpropagate_motion(model, camera, gradients)
    g = {name: values.astype(np.float64) for name, values in grads.items()}
    upstream = g["means"], g["quats"], g["logit_opacity"][:, 0]
    grad_motion, grad_logit = ref.move_gaussians_backward(p[MOTION], logit, *upstream, TIME, degree, has_rotation)
    actual, grad_center = gradients[MOTION].get()[:, :count].T, gradients["logit_opacity"].get()[0, :count]
    kernel = "turn_backward" if has_rotation else "move_backward"
    for name, columns in motion_fields(width).items():
        yield compare(kernel, f"gradient of {name}, {label}", actual[:, columns], grad_motion[:, columns], Tol.CONIC)
    yield compare("move_backward", f"gradient of the logit at the center, {label}", grad_center, grad_logit, Tol.CONIC)


def check_zero_motion(device: Device, rng: np.random.Generator) -> Results:
    """Check that Gaussians with zero motion give the same bits as static Gaussians."""
    case = random_case(rng, 65)
    motion = np.zeros((65, motion_width(3, True)), np.float32)
    motion[:, 3], motion[:, 4] = rng.uniform(0, 1, 65), STATIC_LOG_DURATION
    zero_case = replace(
        case, parameters={**case.parameters, MOTION: motion}, view=replace(case.view, time=float(np.float32(0.7)))
    )
    images = []
    for scene in (case, zero_case):
        frame = Rasterizer(device, "radix").forward(scene.model(device), scene.device_camera(device), device.zeros(3))
        images.append(frame.image.get())
    yield match("move_forward", "an image of Gaussians without motion", images[1], images[0])


def check_step(device: Device, rng: np.random.Generator, count: int, width: int, every: int = 0xFFFFFFFF) -> Results:
    """Compare two updates in which durations reach their bound.  every: as for `update_motion`."""
    case = moving_case(rng, count, width)
    model, rates = case.model(device), MotionRates(log_duration=0.5, min_duration=0.3).at(3, EXTENT)
    gaussians, min_duration = model.gaussians, float(np.log(0.3))
    Adam(gaussians)
    frame = Rasterizer(device, "radix").forward(model, case.device_camera(device), device.zeros(3))
    values, m, v = case.parameters[MOTION].astype(np.float64), np.zeros((count, width)), np.zeros((count, width))
    is_visible = np.full(count, every != 0) | (frame.depth_key.get()[:count] != 0xFFFFFFFF)
    column_rates = np.concatenate([np.full(c.stop - c.start, rates[name]) for name, c in motion_fields(width).items()])
    for step in (1, 2):
        gradient = rng.normal(size=(count, width)).astype(np.float32)
        gradients = GaussianGradients(gaussians)
        planes = np.zeros(gradients[MOTION].shape, np.float32)
        planes[:, :count] = gradient.T
        gradients[MOTION].set(planes)
        values, m, v = ref.adam_step(values, gradient.astype(np.float64), m, v, step, column_rates, mask=is_visible)
        values[is_visible, 4] = np.maximum(values[is_visible, 4], min_duration)
        update_motion(gaussians, gradients, frame.depth_key, rates, step, every)
    label = f"{count} Gaussians, {width} columns" + (", only of visible rows" if every == 0 else "")
    actual, initial = gaussians.get(MOTION), case.parameters[MOTION]
    yield match("motion_step", f"values of invisible rows, {label}", actual[~is_visible], initial[~is_visible])
    yield compare_max("motion_step", f"values, {label}", actual, values, 2e-5, floor=1.0)
    for moment, expected in zip(moment_tables(MOTION), (m, v), strict=True):
        yield compare("motion_step", f"moments, {label}", gaussians.get(moment), expected, 3 * Tol.SUM)


@CHECKS.add("move_forward", "turn_forward", "move_backward", "turn_backward", "motion_step")
def motion(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield from check_motion_at_time(device, rng, count, motion_width(1, False))
        yield from check_step(device, rng, count, motion_width(3, True))
        yield from check_step(device, rng, count, motion_width(3, True), every=0)
    for width in WIDTHS:
        yield from check_motion_at_time(device, rng, 65, width)
    yield from check_zero_motion(device, rng)
