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
SPEED: list[Check] = whole.SPEED.checks
ESSENTIAL: list[Check] = essential.CHECKS.checks
BITONIC: list[Check] = essential.BITONIC.checks  # for runs that may use the bitonic sort
BY_NAME = {check.name: check for check in (*KERNELS, *SPEED, *ESSENTIAL, *BITONIC)}
