"""List the checks of all kernels, and the essential checks, which run when a device is first used."""

from clsplat.conformance.check import Check
from clsplat.conformance.checks import (
    appearance,
    blending,
    density,
    essential,
    images,
    motion,
    nerf,
    pixel_box,
    projection,
    sky,
    tiles,
    training,
    whole,
)

_ORDER = projection, tiles, blending, pixel_box, motion, images, appearance, sky, nerf, training, density, whole
KERNELS: list[Check] = [check for module in _ORDER for check in module.CHECKS.checks]
SPEED_CHECKS: list[Check] = whole.SPEED.checks
ESSENTIAL_CHECKS: list[Check] = essential.CHECKS.checks
BITONIC: list[Check] = essential.BITONIC.checks  # for runs that may use the bitonic sort
_TILE_KERNELS = {"project_forward", "count_large", "emit_large", "blend_forward", "blend_backward"}
TILED = [check for check in KERNELS if not check.kernels or _TILE_KERNELS & {*check.kernels}]  # that tile sizes affect
BY_NAME = {check.name: check for check in (*KERNELS, *SPEED_CHECKS, *ESSENTIAL_CHECKS, *BITONIC)}
