"""Check each kernel that every training step uses, on a small scene, in about two seconds."""

import numpy as np

from clsplat.conformance.check import Checks, Results
from clsplat.conformance.checks import blending, images, projection, tiles, training
from clsplat.conformance.scenes import add_world_filter, random_case, safe_case
from clsplat.opencl.device import Device

CHECKS = Checks()
BITONIC = Checks()  # for runs that may use the bitonic sort


@CHECKS.add("project_forward", "project_backward", "emit_pairs", "blend_forward", "blend_backward", "sum_records")
def rendering(device: Device, rng: np.random.Generator) -> Results:
    case, label = safe_case(rng, 60, 40, 30, blending.MARGIN), "a scene of 60 Gaussians"
    yield from projection.check_record(device, case, label)
    yield from tiles.check_list(device, case, "radix", label)
    yield from blending.check_blend(device, case, label)
    dense_case, dense_label = safe_case(rng, 300, 14, 14, change=blending.make_dim), "300 overlapping Gaussians"
    yield from blending.check_blend(device, dense_case, dense_label)
    for scene, name in ((case, label), (dense_case, dense_label)):
        weights = rng.normal(size=(3, *scene.size[::-1])).astype(np.float32)
        sums = blending.sum_pixels(device, scene, weights)
        yield from blending.check_sum(scene, sums, weights, name)
    yield from projection.check_gradient(device, case, rng, label)
    filtered_case = add_world_filter(random_case(rng, 30, variance=0.1, compensate=1.0), rng)
    yield from projection.check_record(device, filtered_case, "30 filtered Gaussians")
    yield from projection.check_gradient(device, filtered_case, rng, "30 filtered Gaussians")


@CHECKS.add("count_large", "emit_large", "project_forward")
def large_splats(device: Device, rng: np.random.Generator) -> Results:
    case = random_case(rng, 12, 150, 130)
    case.parameters["log_scales"][:4] += 2.5
    yield from tiles.check_list(device, case, "radix", "a scene of large Gaussians")
    yield from tiles.check_large(device, rng)


@CHECKS.add("scan_blocks", "scan_offsets", "radix_count", "radix_scatter")
def sorting(device: Device, rng: np.random.Generator) -> Results:
    for count in (1025, 40_001):  # one block, and several
        yield tiles.check_scan(device, rng.integers(0, 100, count).astype(np.uint32))
    yield tiles.check_scan(device, np.full(40_001, 2**31, np.uint32))  # sums that would overflow
    yield from tiles.check_radix(device, rng.integers(0, 2**20, 1025).astype(np.uint32), 20)


@BITONIC.add("emit_pairs", "emit_large", "count_large", "fill_tiles", "sort_tiles", "merge_runs")
def sorting_in_tiles(device: Device, rng: np.random.Generator) -> Results:
    yield from tiles.check_bitonic(device, rng, (0, 1, 65, 300, 1025), 50)
    case = random_case(rng, 40, 210, 130)
    case.parameters["log_scales"][:4] += 1.5
    yield from tiles.check_list(device, case, "bitonic", "a scene with large Gaussians")


@CHECKS.add("pixel_loss", "ssim_maps", "ssim_gradient", "update_gaussians")
def learning(device: Device, rng: np.random.Generator) -> Results:
    x, y = images.image_pair(rng, 33, 17)
    for loss, oracle, kernel in images.LOSSES:
        yield from images.check_loss(device, loss(weight=0.7), 0.7, oracle, kernel, x, y)
    yield from training.check_fused(device, rng, random_case(rng, 40), "40 Gaussians")
