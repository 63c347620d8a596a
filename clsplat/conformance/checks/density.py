"""Check density control: statistics of views, rules, the rows of an edit, noise, scores, and clusters."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Deviation, Results, Tol, compare, compare_max, match
from clsplat.conformance.checks.blending import BACKGROUND, MARGIN
from clsplat.conformance.checks.images import make_comparison, sobel_magnitude, to_planes
from clsplat.conformance.scenes import Case, add_world_filter, random_case, safe_case
from clsplat.density.control import cap_opacity, densify
from clsplat.density.edit import Edit
from clsplat.density.importance import contributions, sensitivities
from clsplat.density.statistics import ABS_X, SEEN, WEIGHT, SplatStats
from clsplat.density.survey import RenderedView
from clsplat.density.thresholds import SceneScale
from clsplat.gaussians.gaussians import Gaussians
from clsplat.losses.base import Comparison, ViewGradients
from clsplat.methods.adc import Clone, PruneFaint, PruneLarge, SplitLarge
from clsplat.methods.mcmc import add_noise
from clsplat.opencl.device import Device, constants
from clsplat.photos.photographs import Mask, Photograph
from clsplat.render.rasterizer import Rasterizer
from clsplat.stages.palette import average_clusters, find_most_similar, set_clusters
from clsplat.training.adam import Adam

CHECKS = Checks()
COUNTS = (1, 15, 17, 65, 200)
GROWTH_RULES = (Clone(size_below=0.01, opacity="shared"), SplitLarge(size_above=0.01))
RULES = (*GROWTH_RULES, PruneFaint(opacity_below=0.005), PruneLarge(size_above=0.1))
EXTENT = 5.0
SEED, STEP = 3, 3100
SPLAT_XX = int(constants("splat.h")["SPLAT_XX"])
STATISTIC_NAMES = ("screen_grad", "screen_grad_abs_sum", "rendered_texture", "screen_radius", "blend_weight", "gain")


@CHECKS.add(
    *("count_seen", "accumulate_norm", "accumulate_sum", "accumulate_pixel_sum", "accumulate_radius"),
    *("sample_magnitude", "accumulate_error", "accumulate_gain"),
)
def statistics(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        case = random_case(rng, count)
        case.parameters["means"][1::4] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
        model, (width, height) = case.model(device), case.size
        frame = Rasterizer(device, "radix").forward(model, case.device_camera(device), device.zeros(3))
        gaussians, stats = model.gaussians, SplatStats(model.gaussians, STATISTIC_NAMES)
        planes = rng.normal(size=(stats.pixel_sums, gaussians.capacity)).astype(np.float32)
        planes[ABS_X:] = np.abs(planes[ABS_X:])
        image = frame.image.get()[:, :height, :width]
        photograph = image + rng.normal(size=image.shape).astype(np.float32)
        comparison = make_comparison(device, image, photograph)  # with a gradient of 7
        error = ref.view_error(np.full(image.shape, 7.0), image.astype(np.float64), photograph)
        view = ViewGradients(frame, comparison, [], device.upload(planes))
        for _ in range(2):
            stats.add(view, device.upload(planes[:2]))
        radius, half_size = frame.radius.get()[:count], np.array([width / 2, height / 2])
        is_visible, sums = radius > 0, planes[:, :count].T.astype(np.float64)
        splats = frame.splats.get()[:count].astype(np.float64)
        (x, y), conic = splats[:, :2].T, splats[:, SPLAT_XX : SPLAT_XX + 3]
        column, row = np.clip(x, 0, width - 1).astype(int), np.clip(y, 0, height - 1).astype(int)
        columns = {
            ("screen_grad", "accumulate_norm"): ref.screen_gradient(sums[:, :2], width, height),
            ("screen_grad_abs_sum", "accumulate_sum"): sums[:, ABS_X : ABS_X + 2] @ half_size,
            ("rendered_texture", "sample_magnitude"): sobel_magnitude(image)[row, column],
            ("screen_radius", "accumulate_radius"): radius,
            ("blend_weight", "accumulate_pixel_sum"): sums[:, WEIGHT],
            ("gain", "accumulate_gain"): width * height * ref.screen_gain(sums[:, :2], conic),
            ("view_error", "accumulate_error"): np.full(count, error),
        }
        yield match("count_seen", f"views of {count} Gaussians", gaussians.get(SEEN)[:, 0], 2.0 * is_visible)
        for (name, kernel), values in columns.items():
            actual = gaussians.get(f"stats/{name}")[:, 0]
            is_counted = is_visible | (name == "view_error")  # which also counts for invisible Gaussians
            expected = 2 * values * is_counted
            yield compare_max(kernel, f"{name} of {count} Gaussians", actual, expected, Tol.SUM, floor=0.1)


@CHECKS.add("accumulate_splitting")
def splitting_matrices(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        case = safe_case(rng, count, 33, 31, MARGIN)
        case.parameters["means"][1::4] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
        model, camera = case.model(device), case.device_camera(device)
        rasterizer, weights = Rasterizer(device, "radix"), rng.normal(size=(3, 31, 33)).astype(np.float32)
        frame = rasterizer.forward(model, camera, device.upload(BACKGROUND))
        pixel_sums = rasterizer.pixel_sums(model, frame, to_planes(device, camera, weights))
        stats = SplatStats(model.gaussians, ("splitting",))
        comparison = Comparison(rasterizer.workspace, camera, frame.image, frame.image, frame.image)
        for _ in range(2):
            stats.add(ViewGradients(frame, comparison, [], pixel_sums), pixel_sums)
        screen_matrices = ref.splitting_matrices(case.project(), 33, 31, BACKGROUND.astype(np.float64), weights)
        expected = (
            2 * ref.scene_splitting_matrices(case.gaussians(), case.camera(), screen_matrices)[:, *np.triu_indices(3)]
        )
        actual = model.gaussians.get("stats/splitting")
        yield compare("accumulate_splitting", f"matrices of {count} Gaussians", actual, expected, Tol.GRADIENT)


def _run_edit(device: Device, rng: np.random.Generator, count: int) -> tuple[dict[str, NDArray[Any]], Gaussians]:
    """Return the tables of random Gaussians on both sides of each threshold, before and after an edit."""
    case = random_case(rng, count)
    p = case.parameters
    sizes = EXTENT * rng.choice([0.003, 0.03, 0.12, 0.4], (count, 1))
    p["log_scales"][:] = np.log(sizes) + rng.normal(0, 0.2, (count, 3))
    p["logit_opacity"][:] = rng.choice([-7.0, -4.0, 2.0], (count, 1))
    gaussians = case.model(device).gaussians
    Adam(gaussians)
    stats = SplatStats(gaussians)
    for name, table in gaussians.tables.items():
        if name.startswith("adam/"):
            gaussians.set(name, rng.uniform(1, 2, (count, table.components)))
    view_counts = rng.integers(0, 4, (count, 1)).astype(np.float32)
    gaussians.set("stats/screen_grad", view_counts * rng.choice([5e-5, 1e-3], (count, 1)))
    gaussians.set(SEEN, view_counts)
    initial = {name: gaussians.get(name) for name in gaussians.tables}
    edit = Edit(gaussians, stats, SceneScale(EXTENT), STEP, SEED)
    densify(edit, RULES, Rasterizer(device, "radix").tiler)
    return initial, gaussians


@CHECKS.add("start_edit", "mark_rule", "list_rows", "spawn_children", "share_opacity", "gather_rows")
def edits(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        initial, gaussians = _run_edit(device, rng, count)
        size, opacity = np.exp(initial["log_scales"]).max(axis=1), 1 / (1 + np.exp(-initial["logit_opacity"][:, 0]))
        gradient = ref.mean_gradient(initial["stats/screen_grad"][:, 0], initial[SEEN][:, 0])
        actions = ref.adc_actions(gradient, size, opacity, EXTENT, prune_large=True)
        rows = np.select([actions == ref.PRUNE, actions == ref.KEEP], [0, 1], 2)
        source = np.repeat(np.arange(count), rows)
        label = f"an edit of {count} Gaussians"
        yield Deviation("mark_rule", f"rows after {label}", abs(gaussians.count - len(source)), 0, counts=True)
        if gaussians.count != len(source):
            continue
        result = {name: gaussians.get(name) for name in gaussians.tables}
        yield match("list_rows", f"rows after {label}", result["sh_rest"], initial["sh_rest"][source])
        is_split = actions[source] == ref.SPLIT
        is_second = np.concatenate([np.arange(n) for n in rows] or [np.zeros(0)]) == 1
        is_fresh = is_split | ((actions[source] == ref.CLONE) & is_second)
        moment = "adam/means/moment1"
        expected = np.where(is_fresh[:, None], 0, initial[moment][source])
        yield match("list_rows", f"moments after {label}", result[moment], expected)
        means, scales = initial["means"].astype(np.float64)[source], initial["log_scales"].astype(np.float64)[source]
        logits = initial["logit_opacity"].astype(np.float64)[source]
        is_cloned = actions[source] == ref.CLONE
        logits[is_cloned] = ref.shared_logit(logits[is_cloned], 2)
        yield compare_max("share_opacity", f"logits after {label}", result["logit_opacity"], logits, Tol.SUM, floor=1)
        for i in np.flatnonzero(is_split):
            noise = ref.normal3((int(i), STEP, 0, 0), (SEED, 0))
            rotation = ref.rotation_matrix(initial["quats"][source[i]].astype(np.float64))
            means[i] += rotation @ (np.exp(scales[i]) * noise)
        scales[is_split] -= np.log(1.6)
        yield compare("spawn_children", f"means after {label}", result["means"], means, Tol.SUM)
        yield compare_max("spawn_children", f"scales after {label}", result["log_scales"], scales, Tol.SUM, floor=1)


@CHECKS.add("mark_chosen")
def choices(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        gaussians = random_case(rng, count).model(device).gaussians
        edit = Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), STEP, SEED)
        copies, old_rows, shrink = np.ones(count), np.ones(count), np.ones(count)
        for factor in (0.5, 0.25):
            mask, copy_counts = rng.random(count) < 0.7, rng.integers(0, 5, count)
            edit.choose(mask, copy_counts, 3, factor)
            is_changed = mask & ((copy_counts == 0) | (copies == 1))
            copies[is_changed], old_rows[is_changed] = copy_counts[is_changed], np.minimum(copy_counts, 3)[is_changed]
            shrink[is_changed & (copies > 0)] = factor
        for name, expected in (("copies", copies), ("old_rows", old_rows), ("shrink", shrink)):
            yield match("mark_chosen", f"{name} of {count} Gaussians", getattr(edit, name).get(), expected)


@CHECKS.add("cap_opacity")
def opacity_reset(device: Device, rng: np.random.Generator) -> Results:
    for count in COUNTS:
        for case in (random_case(rng, count), add_world_filter(random_case(rng, count), rng)):
            gaussians, oracle = case.model(device).gaussians, case.gaussians()
            cap_opacity(gaussians, 0.3)
            scale2 = np.exp(2 * oracle.log_scales)
            ratio = np.prod(np.sqrt(scale2 / (scale2 + oracle.filter_variance[:, None])), axis=1)
            expected = oracle.logit_opacity.copy()
            is_above = ratio / (1 + np.exp(-expected)) > 0.3
            expected[is_above] = ref.reset_logit(expected[is_above], ratio[is_above], 0.3)
            actual = gaussians.get("logit_opacity")[:, 0]
            yield compare_max("cap_opacity", f"opacities of {count} Gaussians", actual, expected, 2e-5, floor=1)


@CHECKS.add("add_noise")
def noise(device: Device, rng: np.random.Generator) -> Results:
    rate, threshold = 40.0, 0.3
    for count in COUNTS:
        case = random_case(rng, count)
        case.parameters["logit_opacity"][:] = rng.uniform(-3, 1, (count, 1))
        gaussians, p = case.model(device).gaussians, {k: v.astype(np.float64) for k, v in case.parameters.items()}
        add_noise(gaussians, rate, threshold, SEED, STEP)
        opacity = 1 / (1 + np.exp(-p["logit_opacity"][:, 0]))
        gate = np.where(opacity > threshold + 0.1, 0, rate / (1 + np.exp(-100 * (threshold - opacity))))
        offsets = np.zeros((count, 3))
        for i in range(count):
            axes = ref.rotation_matrix(p["quats"][i]) * np.exp(p["log_scales"][i])
            offsets[i] = gate[i] * axes @ axes.T @ ref.normal3((i, STEP, 1, 0), (SEED, 0))
        actual = gaussians.get("means").astype(np.float64)
        yield compare("add_noise", f"means of {count} Gaussians", actual, p["means"] + offsets, Tol.SUM)


# Compression of a model: the contribution of each Gaussian, and clusters for a palette.

SIZES = ((1, 16, 16), (17, 33, 15), (30, 40, 30))  # Gaussians, width, height: complete and partial tiles


def black_photograph(device: Device, case: Case, mask: Mask | None = None) -> Photograph:
    """Return a black photograph taken by the camera of a case."""
    camera = case.device_camera(device)
    colors = device.upload(np.zeros((3, camera.height, camera.width), np.uint8))
    return Photograph(camera, colors, None if mask is None else device.upload(mask[None].astype(np.uint8)))


@CHECKS.add("blend_backward")
def contribution(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in SIZES:
        case = safe_case(rng, count, width, height, MARGIN)
        masks = (None, rng.random((height, width)) < 0.6)
        photographs = [black_photograph(device, case, mask) for mask in masks]
        expected = sum(ref.contribution(case.project(), width, height, mask) for mask in masks)
        black, background = np.zeros(3, np.float32), rng.random(3).astype(np.float32)
        actual, repetition = (contributions(_render_views(device, case, photographs, black), count) for _ in range(2))
        label = f"blend weights of {count} Gaussians"
        yield compare_max("blend_backward", label, actual, np.asarray(expected), Tol.SUM, floor=0.1)
        yield match("blend_backward", f"{label}, a second time", repetition, actual)
        actual = sensitivities(_render_views(device, case, photographs, background), count)
        squares = np.sum([_falloff_squares(case, background, mask) for mask in masks], axis=0)
        yield compare("blend_backward", f"squared image changes, {count} Gaussians", actual, squares, Tol.GRADIENT)


def _render_views(
    device: Device, case: Case, photographs: list[Photograph], background: NDArray[Any]
) -> Iterator[RenderedView]:
    """Render the views of photographs with a new rasterizer from a new model, and yield each."""
    rasterizer = Rasterizer(device, "radix")
    return RenderedView.render_all(rasterizer, case.model(device), photographs, device.upload(background))


def _falloff_squares(case: Case, background: NDArray[Any], mask: Mask | None) -> NDArray[Any]:
    """Return (dI/dG)² summed over the channels and the pixels of a mask, [N]."""
    width, height = case.size
    weights, total = np.ones((height, width)) if mask is None else mask, np.zeros(len(case.project().opacity))
    for channel in range(3):
        gradient = weights * (np.arange(3) == channel)[:, None, None]
        total += ref.falloff_squares(case.project(), width, height, background.astype(np.float64), gradient)
    return total


@CHECKS.add("most_alike")
def most_alike_labels(device: Device, rng: np.random.Generator) -> Results:
    """Compare the index of each point's most similar vector.  Values are integers, so all products are exact."""
    for count, entries, components in ((1, 1, 3), (17, 9, 45), (130, 21, 9)):
        points, vectors = (rng.integers(-511, 512, (rows, components)).astype(np.float32) for rows in (count, entries))
        vectors[-1] = vectors[0]  # a tie, which the first wins
        actual, expected = find_most_similar(device, points, vectors), (points @ vectors.T).argmax(axis=1)
        yield match("most_alike", f"labels of {count} points and {entries} vectors", actual, expected)


@CHECKS.add("share_mean")
def shared_means(device: Device, rng: np.random.Generator) -> Results:
    for count, clusters in ((1, 1), (17, 3), (130, 40)):
        gaussians = random_case(rng, count).model(device).gaussians
        values, labels = gaussians.get("sh_rest"), rng.integers(0, clusters, count)
        weights = rng.random(count).astype(np.float32) * (labels != 0)  # one cluster has no weight
        set_clusters(gaussians, labels, weights)
        average_clusters(gaussians, "sh_rest")
        label, actual = f"means of {clusters} clusters of {count} Gaussians", gaussians.get("sh_rest")
        yield compare_max("share_mean", label, actual, ref.shared_means(values, labels, weights), Tol.SUM, floor=0.1)
        average_clusters(gaussians, "sh_rest")
        yield match("share_mean", f"{label}, a second time", gaussians.get("sh_rest"), actual)
