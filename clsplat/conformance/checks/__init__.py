"""The checks of all kernels, and those that a run does once on a device that it meets for the first time."""

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

KERNELS: list[Check] = [
    *projection.CHECKS.listed,
    *tiles.CHECKS.listed,
    *blending.CHECKS.listed,
    *pixel_box.CHECKS.listed,
    *motion.CHECKS.listed,
    *images.CHECKS.listed,
    *appearance.CHECKS.listed,
    *sky.CHECKS.listed,
    *nerf.CHECKS.listed,
    *training.CHECKS.listed,
    *density.CHECKS.listed,
    *whole.CHECKS.listed,
]
SPEED: list[Check] = whole.SPEED.listed
ESSENTIAL: list[Check] = essential.CHECKS.listed
BITONIC: list[Check] = essential.BITONIC.listed  # where a run may sort so
BY_NAME = {check.name: check for check in (*KERNELS, *SPEED, *ESSENTIAL, *BITONIC)}
