"""Check the kernels of training: Adam, deferred updates, penalties, updates of visible rows, averages, and dropout."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Deviation, Results, Tol, compare, compare_max, match
from clsplat.conformance.checks.blending import BACKGROUND
from clsplat.conformance.checks.projection import COUNTS as DROPOUT_COUNTS
from clsplat.conformance.checks.projection import check_gradient, check_record, expected_gradients, project_records
from clsplat.conformance.scenes import Case, add_world_filter, random_case
from clsplat.density.statistics import ABS_X, SplatStats
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.deferred import DeferredHarmonics
from clsplat.gaussians.gaussians import INTERVAL2, DeviceModel, DropoutMask, Gaussians, hide
from clsplat.gaussians.structs import GaussianGradients, moment_tables
from clsplat.losses.base import Penalty, PenaltyInputs
from clsplat.losses.penalties import Anisotropy, CovarianceTrace, MeanOpacity, MeanScale, MinScale
from clsplat.methods.natural_selection import OpacityPressure
from clsplat.opencl.device import Device, constants
from clsplat.render.rasterizer import PIXEL_SUMS, RECORD, Frame, PixelSums, Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.training import adam
from clsplat.training.adam import Adam, Rates, Rows

CHECKS = Checks()
COUNTS = (1, 15, 17, 65)
EXTENT = 2.5
SPLAT_OPACITY = int(constants("splat.h")["SPLAT_OPACITY"])


def check_step(device: Device, rng: np.random.Generator, count: int) -> Results:
    """Compare three Adam updates from gradients of very different magnitudes."""
    case = random_case(rng, count)
    model = case.model(device)
    adam, rates = Adam(model.gaussians), Rates().at(3, extent=2.0)
    frame = Rasterizer(device, "radix").forward(model, case.device_camera(device), device.upload(BACKGROUND))
    values = {name: case.parameters[name].astype(np.float64) for name in PARAMETERS}
    moments = {name: [np.zeros_like(v), np.zeros_like(v)] for name, v in values.items()}
    for step in range(1, 4):
        gradients = GaussianGradients(model.gaussians)
        for name in PARAMETERS:
            shape = values[name].shape
            gradient = (rng.normal(size=shape) * rng.choice([1e-7, 1e-3, 1], shape)).astype(np.float32)
            gradient[::3] = 0
            planes = np.zeros(gradients[name].shape, np.float32)
            planes[:, :count] = gradient.T
            gradients[name].set(planes)
            values[name], *moments[name] = ref.adam_step(
                values[name], gradient.astype(np.float64), moments[name][0], moments[name][1], step, rates[name]
            )
        adam.step(model, frame, gradients, rates)
    for name in PARAMETERS:
        max_change, label = float(np.abs(values[name] - case.parameters[name]).max()), f"{name}, {count} Gaussians"
        actual = model.gaussians.get(name)
        # values are rounded to float32, and their changes to 2e-5 of the largest change
        yield compare_max("adam_step", label, actual, values[name], 3e-7, floor=2e-5 * max_change / 3e-7)
        # 1 - 0.999f is off by 1.3e-5 in float32
        for moment, expected, bound in zip(moment_tables(name), moments[name], (Tol.SUM, 3 * Tol.SUM), strict=True):
            max_moment = float(np.abs(expected).max())
            actual = model.gaussians.get(moment)
            yield compare_max("adam_step", f"moments of {label}", actual, expected, bound, floor=0.1 * max_moment)


def _random_pixel_sums(
    device: Device,
    rng: np.random.Generator,
    case: Case,
    rasterizer: Rasterizer,
    model: DeviceModel,
    count: int = PIXEL_SUMS,
) -> tuple[Frame, PixelSums]:
    """Return the frame of a case, and its sums over pixels for a random gradient of the image."""
    camera = case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
    weights = np.zeros((3, camera.rows, camera.stride), np.float32)
    weights[:, : camera.height, : camera.width] = rng.normal(size=(3, camera.height, camera.width))
    return frame, rasterizer.backward(model, frame, device.upload(weights), count)


def check_fused(
    device: Device, rng: np.random.Generator, case: Case, label: str, statistic: str = "screen_grad"
) -> Results:
    """Compare moments, values, and a statistic after one fused update.

    Expected values are computed from the device's moments, and from its sums over pixels.
    """
    kernel, count = "update_gaussians", len(case.parameters["means"])
    rasterizer, model = Rasterizer(device, "radix"), case.model(device)
    gaussians, adam, rates = model.gaussians, Adam(model.gaussians), Rates().at(3, extent=2.0)
    stats = SplatStats(gaussians, [statistic, "screen_radius"])  # the update does not add the radius
    frame, pixel_sums = _random_pixel_sums(device, rng, case, rasterizer, model, stats.pixel_sums)
    pixel_sums.arguments()["pixel_sums"].fill(7)  # the update does not read them
    stats.view_count.fill(2)
    stats.total(statistic).fill(1)
    grad_mean2d = adam.update(model, frame, pixel_sums, rates, statistics=stats.update_arguments()).get()[:, :count].T
    sums = pixel_sums.array.get()[:, :count].T.astype(np.float64)
    expected = expected_gradients(case, case.project(), sums[:, :PIXEL_SUMS])
    yield compare(kernel, f"gradients of the projected means, {label}", grad_mean2d, expected["mean2d"], Tol.CONIC)
    planes, is_visible = sums[:, ABS_X:] if stats.pixel_sums > ABS_X else grad_mean2d, frame.radius.get()[:count] > 0
    norms = 1 + is_visible * ref.screen_gradient(planes.astype(np.float64), *case.size)
    yield compare_max(kernel, f"{statistic}, {label}", stats.total(statistic).get()[0, :count], norms, Tol.SUM)
    yield match(kernel, f"views, {label}", stats.view_count.get()[0, :count], 2.0 + is_visible)
    for name in PARAMETERS:
        moment1, moment2 = (gaussians.get(table).astype(np.float64) for table in moment_tables(name))
        yield compare(kernel, f"first moment of {name}, {label}", moment1, 0.1 * expected[name], Tol.CONIC)
        yield compare(kernel, f"second moment of {name}, {label}", moment2, 1e-3 * expected[name] ** 2, 2 * Tol.CONIC)
        step = rates[name] * (moment1 / 0.1) / (np.sqrt(moment2 / 1e-3) + 1e-15)
        initial = case.parameters[name].astype(np.float64)
        floor = 2e-5 * max(float(np.abs(step).max()), 1e-30) / 3e-7
        yield compare_max(kernel, f"{name}, {label}", gaussians.get(name), initial - step, 3e-7, floor)


def check_rows(device: Device, rng: np.random.Generator, case: Case, label: str) -> Results:
    """Compare the fifth update of visible rows by each kernel.  All kernels get the same gradients and moments."""
    count, rates, parameters = len(case.parameters["means"]), Rates().at(3, extent=2.0), case.parameters
    moments = {
        name: (rng.normal(size=values.shape), rng.uniform(0.5, 2, values.shape))
        for name, values in parameters.items()
        if name in PARAMETERS
    }
    for kernel in ("update_gaussians", "adam_step"):
        rasterizer, model = Rasterizer(device, "radix"), case.model(device)
        gaussians, adam = model.gaussians, Adam(model.gaussians)
        frame, pixel_sums = _random_pixel_sums(device, rng, case, rasterizer, model)
        gradients = rasterizer.gradients(model, frame, pixel_sums.array)
        is_visible = frame.splats.get().reshape(-1, RECORD)[:count, SPLAT_OPACITY] > 0
        adam.updates = dict.fromkeys(PARAMETERS, 4)
        expected: dict[str, NDArray[Any]] = {}
        for name in PARAMETERS:
            for table, values in zip(moment_tables(name), moments[name], strict=True):
                gaussians.set(table, values)
            tables = name, *moment_tables(name)
            initial, moment1, moment2 = (gaussians.get(table).astype(np.float64) for table in tables)
            gradient = gradients[name].get()[:, :count].T.astype(np.float64)
            results = ref.adam_step(initial, gradient, moment1, moment2, 5, rates[name], mask=is_visible)
            expected |= dict(zip(tables, results, strict=True))
        if kernel == "adam_step":
            adam.step(model, frame, gradients, rates, rows="seen")
        else:
            adam.update(model, frame, pixel_sums, rates, rows="seen")
        for table, truth in expected.items():
            actual = gaussians.get(table)
            yield match(kernel, f"{table} of invisible rows, {label}", actual[~is_visible], truth[~is_visible])
            yield compare_max(
                kernel,
                f"{table} of visible rows, {label}",
                actual[is_visible],
                truth[is_visible],
                3 * Tol.SUM,
                floor=0.1,
            )


def move_every_fifth_behind(case: Case) -> Case:
    """Return the case with every fifth Gaussian behind the camera."""
    case.parameters["means"][1::5] -= 20 * case.view.world_to_camera[2, :3]
    return case


@CHECKS.add("adam_step")
def adam_updates(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield from check_step(device, rng, count)


@CHECKS.add("adam_step", "update_gaussians")
def adam_of_seen_rows(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield from check_rows(device, rng, move_every_fifth_behind(random_case(rng, count)), f"{count} Gaussians")


@CHECKS.add("update_gaussians")
def update_from_sums_over_pixels(device: Device, rng: np.random.Generator) -> Results:
    for count, degree in ((1, 3), (17, 0), (40, 2), (150, 3)):
        case = add_world_filter(random_case(rng, count, degree=degree, compensate=1.0), rng)
        label, statistic = f"{count} Gaussians, degree {degree}", "screen_grad_abs" if count == 40 else "screen_grad"
        yield from check_fused(device, rng, move_every_fifth_behind(case), label, statistic)


def check_penalty(
    device: Device,
    rng: np.random.Generator,
    count: int,
    penalty: Penalty,
    oracle: Any,
    interval: NDArray[Any] | None = None,
    parameter: str = "log_scales",
) -> Results:
    """Compare the value and the gradient of a penalty of weight 3, for Gaussians of many sizes and shapes."""
    case = random_case(rng, count)
    case.parameters["log_scales"][:] = rng.normal(-2, 1.5, (count, 3))
    gaussians = case.model(device).gaussians
    if interval is not None:
        gaussians.add(INTERVAL2, 1)
        gaussians.set(INTERVAL2, interval[:, None] ** 2)
    gradients = GaussianGradients(gaussians)
    gradients[parameter].fill(0.25)
    inputs = PenaltyInputs(Workspace(device), gaussians, gradients, EXTENT, step=1)
    actual = penalty.add(inputs).value()
    value, gradient = oracle(case.parameters[parameter].astype(np.float64))
    kernel, label = str(getattr(penalty, "type", "penalty")), f"{count} Gaussians"
    yield compare_max(kernel, f"value, {label}", np.array([actual]), np.array([3 * value]), Tol.SUM, floor=1e-7)
    actual_gradient = gradients[parameter].get()[:, :count].T.astype(np.float64) - 0.25
    floor = 1e-2 * max(1.0, float(np.abs(3 * gradient).max()))
    yield compare_max(kernel, f"gradient, {label}", actual_gradient, 3 * gradient, 1e-4, floor)


@CHECKS.add("covariance_trace", "anisotropy", "mean_scale", "min_scale", "mean_opacity", "opacity_pressure")
def penalties(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        interval = rng.uniform(0.01, 0.05, count).astype(np.float32)
        trace = CovarianceTrace(weight=3.0, above=0.02)
        yield from check_penalty(device, rng, count, trace, lambda s: ref.covariance_trace(s, 0.02 * EXTENT**2, EXTENT))
        pixel_trace = CovarianceTrace(weight=3.0, above=9.0, pixels=4.0)
        bound = 3 * (4.0 * interval) ** 2
        yield from check_penalty(
            device, rng, count, pixel_trace, lambda s, bound=bound: ref.covariance_trace(s, bound, EXTENT), interval
        )
        shape = Anisotropy(weight=3.0, above=8.0)
        yield from check_penalty(device, rng, count, shape, lambda s: ref.anisotropy(s, 8.0))
        yield from check_penalty(device, rng, count, MeanScale(weight=3.0), lambda s: ref.mean_scale(s, EXTENT))
        yield from check_penalty(device, rng, count, MinScale(weight=3.0), lambda s: ref.min_scale(s, EXTENT))
        opacity = MeanOpacity(weight=3.0)
        yield from check_penalty(device, rng, count, opacity, ref.mean_opacity, parameter="logit_opacity")
        pressure = OpacityPressure(weight=3.0, floor=-0.5)
        yield from check_penalty(
            device, rng, count, pressure, lambda logits: ref.opacity_pressure(logits, -0.5), parameter="logit_opacity"
        )


def _tables(gaussians: Gaussians) -> dict[str, NDArray[Any]]:
    return {name: gaussians[name].get() for name in gaussians.tables}


@CHECKS.add("set_rows", "zero_rows", "gather_rows", "count_not_finite", "fill_words")
def rows_of_tables(device: Device, rng: np.random.Generator) -> Results:
    for count in (0, 1, 15, 17, 1025):
        array = device.upload(np.full(count, 3, np.float32))
        array.fill(-1.5)
        yield match("fill_words", f"{count} values", array.get(), -1.5)
    gaussians = random_case(rng, 65).model(device).gaussians
    expected_tables, rows, values = _tables(gaussians), rng.permutation(65)[:17], rng.normal(size=(17, 45))
    gaussians.set_rows("sh_rest", rows, values)
    expected_tables["sh_rest"][:, rows] = values.T.astype(np.float32)
    gaussians.zero_rows(["quats"], rows)
    expected_tables["quats"][:, rows] = 0
    for name, kernel in (("sh_rest", "set_rows"), ("quats", "zero_rows"), ("means", "set_rows")):
        yield match(kernel, f"17 rows of {name}", gaussians[name].get(), expected_tables[name])
    source, fresh = rng.integers(0, 65, 150).astype(np.uint32), rng.integers(0, 2, 150).astype(np.uint32)
    gaussians.add("fresh", 2, zero_fresh=True)
    gaussians.set("fresh", rng.normal(size=(65, 2)))
    tables = {name: gaussians.get(name) for name in gaussians.tables}
    gaussians.rearrange(device.upload(source), device.upload(fresh), 150)
    for name, table in tables.items():
        expected = table[source] * (1 if name != "fresh" else 1 - fresh[:, None])
        yield match("gather_rows", f"150 rows of {name}", gaussians.get(name), expected)
    for value in (np.nan, np.inf, -np.inf):
        case = random_case(rng, 65)
        case.parameters["quats"][64, 2] = case.parameters["sh_rest"][0, 44] = value
        actual = case.model(device).gaussians.find_nonfinite()
        wrong_names = {"quats", "sh_rest"} ^ set(actual)
        yield Deviation("count_not_finite", f"tables with {value}", len(wrong_names), 0, counts=True)


# Updates of harmonics that are deferred until their Gaussians are visible again.

DEFERRED_COUNTS = (1, 15, 17, 65, 150)
CULLED = 0xFFFFFFFF
MAX_DEFERRED = 5  # less than STEPS, so that the list fills up once
STEPS = 8


def random_visible_rows(rng: np.random.Generator, count: int) -> NDArray[np.bool_]:
    """Return a random mask, [N], of the rows visible in a view: a few rows in some of the blocks of 16."""
    blocks = rng.random(-(-count // 16)) < 0.4
    return blocks.repeat(16)[:count] & (rng.random(count) < 0.5)


def train(
    device: Device, model: DeviceModel, masks: list[NDArray[np.bool_]], gradients: list[NDArray[np.float32]], rows: Rows
) -> dict[str, NDArray[np.float32]]:
    """Update a model once for each view, and return the SH coefficients and their moments.

    masks: for each view, the mask of visible rows, [N]; gradients: of the SH coefficients, [N, components].
    """
    gaussians, adam = model.gaussians, Adam(model.gaussians)
    camera = random_case(np.random.default_rng(0), 1).device_camera(device)
    frame = Rasterizer(device, "radix").forward(model, camera, device.upload(BACKGROUND))
    deferred = gaussians.deferred = DeferredHarmonics(gaussians, MAX_DEFERRED) if rows == "deferred" else None
    for step, (mask, gradient) in enumerate(zip(masks, gradients, strict=True), 1):
        keys = np.full(gaussians.capacity, CULLED, np.uint32)
        keys[: gaussians.count][mask] = 7
        view_frame = replace(frame, depth_key=device.upload(keys))
        loss_gradients = GaussianGradients(gaussians)
        planes = np.zeros(loss_gradients["sh_rest"].shape, np.float32)
        planes[:, : gaussians.count] = gradient.T
        loss_gradients["sh_rest"].set(planes)
        if deferred:
            deferred.flush_visible(view_frame.depth_key)
        excluded_names = set(gaussians.trained) - {"sh_rest"}
        adam.step(model, view_frame, loss_gradients, Rates().at(step, extent=2.0), excluded_names, rows)
    return {name: gaussians.get(name) for name in DeferredHarmonics.names}


def check_deferred(device: Device, rng: np.random.Generator, count: int) -> Results:
    """Compare deferred updates with the reference; check that they are bit-identical to immediate updates."""
    case = random_case(rng, count)
    initial = case.parameters["sh_rest"]
    masks = [random_visible_rows(rng, count) for _ in range(STEPS)]
    gradients = [rng.normal(size=initial.shape).astype(np.float32) * mask[:, None] for mask in masks]
    values, moment1, moment2 = initial.astype(np.float64), np.zeros(initial.shape), np.zeros(initial.shape)
    for step, gradient in enumerate(gradients, 1):
        rate = Rates().at(step, extent=2.0)["sh_rest"]
        values, moment1, moment2 = ref.adam_step(values, gradient.astype(np.float64), moment1, moment2, step, rate)
    actual = train(device, case.model(device), masks, gradients, "deferred")
    immediate = train(device, case.model(device), masks, gradients, "all")
    max_change = max(float(np.abs(values - initial).max(initial=0)), 1e-6)
    yield compare_max("replay_updates", f"{count} Gaussians", actual["sh_rest"], values, 3e-7, 2e-5 * max_change / 3e-7)
    for name, expected, bound in zip(
        DeferredHarmonics.names[1:], (moment1, moment2), (Tol.SUM, 3 * Tol.SUM), strict=True
    ):
        floor = 0.1 * float(np.abs(expected).max(initial=0))
        yield compare_max("replay_updates", f"{name}, {count} Gaussians", actual[name], expected, bound, floor)
    for name in DeferredHarmonics.names:
        bits, expected_bits = actual[name].view(np.uint32), immediate[name].view(np.uint32)
        yield match("note_update", f"bits of {name}, {count} Gaussians", bits, expected_bits)


@CHECKS.add("replay_updates", "note_update", "adam_step")
def updates_that_wait(device: Device, rng: np.random.Generator) -> Results:
    for count in DEFERRED_COUNTS:
        yield from check_deferred(device, rng, count)


@CHECKS.add("add_to_average", "count_step", "take_average")
def averages(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        yield from check_average(device, rng, count)


def check_average(device: Device, rng: np.random.Generator, count: int) -> Results:
    """Compare the average over three steps.  If there are several rows, the last is created after the first step."""
    steps = [random_case(rng, count).parameters for _ in range(3)]
    gaussians = random_case(rng, count).model(device).gaussians
    adam.attach_average(gaussians)
    for step, parameters in enumerate(steps):
        for name in PARAMETERS:
            gaussians.set(name, parameters[name])
        adam.add_to_average(gaussians)
        if step == 0 and count > 1:
            source, fresh = np.arange(count, dtype=np.uint32), np.zeros(count, np.uint32)
            fresh[-1] = 1
            gaussians.rearrange(device.upload(source), device.upload(fresh), count)
    for name in PARAMETERS:
        gaussians.set(name, steps[0][name])
    adam.apply_average(gaussians)
    for name in PARAMETERS:
        values = np.stack([parameters[name].astype(np.float64) for parameters in steps])
        expected = values.mean(axis=0)
        expected[-1] = values[1 if count > 1 else 0 :, -1].mean(axis=0)
        actual = gaussians.get(name)
        yield compare_max("take_average", f"average of {name}, {count} Gaussians", actual, expected, Tol.SUM, floor=1)


# dropout.cl, and the projection of the remaining Gaussians.

SEED, STEP = 0x9E3779B9, 700
DROPOUT = DropoutMask(0.3, SEED, STEP)


def check_dropout(device: Device, case: Case, rng: np.random.Generator, label: str) -> Results:
    """Compare the records and the gradients of a step that drops Gaussians."""
    yield from check_record(device, case, label)
    yield from check_gradient(device, case, rng, label)


def check_hidden(device: Device, case: Case, rng: np.random.Generator) -> Results:
    """Hide some Gaussians in a view, and drop others; check that none of them has records."""
    model, camera, count = case.model(device), case.device_camera(device), len(case.parameters["means"])
    hidden_masks = rng.random((2, count)) < 0.5
    hide(model.gaussians, hidden_masks)
    actual = Rasterizer(device, "radix").forward(model, replace(camera, view_index=1), device.zeros(3)).splats.get()
    expected, _, _ = project_records(device, case)
    expected[hidden_masks[1]] = 0
    yield match("draw_left_out", f"records of {count} Gaussians, some dropped and some hidden", actual, expected)


@CHECKS.add("draw_left_out", "project_forward", "project_backward")
def dropout(device: Device, rng: np.random.Generator) -> Results:
    for count in DROPOUT_COUNTS:
        case = replace(random_case(rng, count), dropout=DROPOUT)
        yield from check_dropout(device, case, rng, f"{count} Gaussians, some dropped")
        yield from check_hidden(device, case, rng)
    case = add_world_filter(random_case(rng, 30, variance=0.1, compensate=1.0), rng)
    yield from check_dropout(device, replace(case, dropout=DROPOUT), rng, "30 filtered Gaussians, some dropped")
