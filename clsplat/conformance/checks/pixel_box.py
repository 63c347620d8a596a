"""Check the box filter, which integrates splats over each pixel: records, images, sums, gradients, and updates."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Results, Tol, compare, match
from clsplat.conformance.checks.blending import (
    ALL_SUMS,
    BACKGROUND,
    MARGIN,
    check_blend,
    check_sum,
    make_dim,
    render,
    sum_pixels,
)
from clsplat.conformance.checks.projection import check_gradient, check_record
from clsplat.conformance.checks.training import check_fused
from clsplat.conformance.scenes import Case, add_world_filter, random_case, safe_case
from clsplat.density.survey import SQUARE
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import RenderLimits

CHECKS = Checks()
BOX: dict[str, Any] = {"variance": 0.0, "pixel_box": 1.0}
SIZES = {"of a few pixels": 0.0, "far below a pixel": -2.5, "of many pixels": 2.0}  # added to the log scales


def sized_case(size: float, rng: np.random.Generator, count: int, width: int, height: int) -> Case:
    def change(parameters: dict[str, NDArray[Any]]) -> None:
        parameters["log_scales"] += np.float32(size)
        parameters["logit_opacity"] += np.float32(max(0, -size))

    return safe_case(rng, count, width, height, MARGIN, change, **BOX)


@CHECKS.add("project_forward", "project_backward", "update_gaussians")
def projection_for_the_pixel_box(device: Device, rng: np.random.Generator) -> Results:
    for count in (1, 17, 65):
        case, label = random_case(rng, count, **BOX), f"{count} Gaussians with the box filter"
        yield from check_record(device, case, label)
        yield from check_gradient(device, case, rng, label)
    filtered_case = add_world_filter(random_case(rng, 30, **BOX), rng)
    yield from check_record(device, filtered_case, "filtered Gaussians with the box filter")
    yield from check_gradient(device, filtered_case, rng, "filtered Gaussians with the box filter")
    yield from check_fused(device, rng, random_case(rng, 40, **BOX), "40 Gaussians with the box filter")


@CHECKS.add("blend_forward", "blend_backward", "count_large", "emit_large")
def blending_over_the_pixel_box(device: Device, rng: np.random.Generator) -> Results:
    for count, width, height in ((0, 20, 20), (1, 16, 16), (17, 33, 15), (65, 40, 30)):
        case = sized_case(0.0, rng, count, width, height)
        yield from check_blend(device, case, f"{count} Gaussians with the box filter, {width} x {height} px")
    case = safe_case(rng, 300, 14, 14, 2e-6, make_dim, **BOX)
    yield from check_blend(device, case, "long tiles with the box filter")
    for label, size in SIZES.items():
        case = sized_case(size, rng, 25, 40, 30)
        yield from check_blend(device, case, f"splats {label} with the box filter")
        weights = rng.normal(size=(3, 30, 40)).astype(np.float32)
        sums = sum_pixels(device, case, weights, ALL_SUMS, texture=np.ones((30, 40), np.float32))
        yield from check_sum(case, sums, weights, f"splats {label} with the box filter")
        squares = ref.falloff_squares(case.project(), 40, 30, BACKGROUND.astype(np.float64), weights)
        yield compare("blend_backward", f"sums of squares, {label}", sums[:, SQUARE], squares, Tol.GRADIENT)
    default_sums = sum_pixels(device, case, weights)
    yield from check_sum(case, default_sums, weights, "without additional sums with the box filter")


@CHECKS.add("blend_forward", "blend_backward", "emit_large")
def the_pixel_box_in_bands(device: Device, rng: np.random.Generator) -> Results:
    case = random_case(rng, 60, 150, 130, **BOX)
    case.parameters["log_scales"][:10] += 1.5
    weights = rng.normal(size=(3, 130, 150)).astype(np.float32)
    image = render(device, case).image.get()
    bitonic_image = render(device, case, "bitonic").image.get()
    yield match("sort_tiles", "pixels with the box filter, against the radix sort", bitonic_image, image)
    sums = sum_pixels(device, case, weights)
    band_sums = sum_pixels(device, case, weights, budget=RenderLimits(250, 3))
    yield match("blend_backward", "sums over pixels with the box filter, against bands of tiles", band_sums, sums)
