"""The two-second form: the kernels of every training step, each once, on one small scene."""

from collections.abc import Iterator

import numpy as np

from clsplat.conformance.check import Checks, Figure, Note
from clsplat.conformance.checks import blending, images, projection, tiles, training
from clsplat.conformance.checks import tiles as large
from clsplat.conformance.scenes import random_case, safe_case, with_world_filter
from clsplat.opencl.device import Device

CHECKS = Checks()
BITONIC = Checks()  # only where a run may sort so


@CHECKS.add("project_forward", "project_backward", "emit_pairs", "blend_forward", "blend_backward", "sum_records")
def rendering(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    case, what = safe_case(rng, 60, 40, 30, blending.MARGIN), "a scene of 60 Gaussians"
    yield from projection.record_figures(device, case, what)
    yield from tiles.list_figures(device, case, "radix", what)
    yield from blending.blend_figures(device, case, what)
    many = safe_case(rng, 300, 14, 14, change=blending.dim)
    yield from blending.blend_figures(device, many, "300 that cover each other")
    for one, of in ((case, what), (many, "300 that cover each other")):
        weights = rng.normal(size=(3, *one.size[::-1])).astype(np.float32)
        yield from blending.sum_figures(one, blending.pixel_sums_of(device, one, weights), weights, of)
    yield from projection.gradient_figures(device, case, rng, what)
    filtered = with_world_filter(random_case(rng, 30, variance=0.1, compensate=1.0), rng)
    yield from projection.record_figures(device, filtered, "30 filtered Gaussians")
    yield from projection.gradient_figures(device, filtered, rng, "30 filtered Gaussians")


@CHECKS.add("count_large", "emit_large", "project_forward")
def large_splats(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    case = random_case(rng, 12, 150, 130)
    case.parameters["log_scales"][:4] += 2.5
    yield from tiles.list_figures(device, case, "radix", "a scene of large Gaussians")
    yield from large.all_figures(device, rng)


@CHECKS.add("scan_blocks", "scan_offsets", "radix_count", "radix_scatter")
def sorting(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count in (1025, 40_001):  # one block, and several
        yield tiles.scan_figure(device, rng.integers(0, 100, count).astype(np.uint32))
    yield tiles.scan_figure(device, np.full(40_001, 2**31, np.uint32))  # sums that would wrap
    yield from tiles.radix_figures(device, rng.integers(0, 2**20, 1025).astype(np.uint32), 20)


@BITONIC.add("count_pairs", "fill_tiles", "sort_tiles")
def sorting_in_tiles(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    yield from tiles.bitonic_figures(device, rng, (0, 1, 65, 300), 50)


@CHECKS.add("pixel_loss", "ssim_maps", "ssim_gradient", "update_gaussians")
def learning(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    x, y = images.pictures(rng, 33, 17)
    for loss, oracle, kernel in images.LOSSES:
        yield from images.loss_figures(device, loss(weight=0.7), 0.7, oracle, kernel, x, y)
    yield from training.fused_figures(device, rng, random_case(rng, 40), "40 Gaussians")
