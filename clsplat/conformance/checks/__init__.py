"""The checks of all kernels, and those that a run does once on a device that it meets for the first time."""

from clsplat.conformance.check import Check
from clsplat.conformance.checks import (
    averages,
    blending,
    colour_grids,
    colours,
    compression,
    cones,
    deferred,
    density,
    depths,
    dropout,
    essential,
    fields,
    grids,
    images,
    large,
    layer,
    motion,
    pixel_box,
    poses,
    projection,
    sky,
    tiles,
    transients,
    update,
    whole,
)

KERNELS: list[Check] = [
    *projection.CHECKS.listed,
    *dropout.CHECKS.listed,
    *tiles.CHECKS.listed,
    *large.CHECKS.listed,
    *blending.CHECKS.listed,
    *pixel_box.CHECKS.listed,
    *motion.CHECKS.listed,
    *poses.CHECKS.listed,
    *depths.CHECKS.listed,
    *images.CHECKS.listed,
    *colours.CHECKS.listed,
    *colour_grids.CHECKS.listed,
    *sky.CHECKS.listed,
    *layer.CHECKS.listed,
    *transients.CHECKS.listed,
    *cones.CHECKS.listed,
    *grids.CHECKS.listed,
    *fields.CHECKS.listed,
    *update.CHECKS.listed,
    *deferred.CHECKS.listed,
    *averages.CHECKS.listed,
    *density.CHECKS.listed,
    *compression.CHECKS.listed,
    *whole.CHECKS.listed,
]
SPEED: list[Check] = whole.SPEED.listed
ESSENTIAL: list[Check] = essential.CHECKS.listed
BITONIC: list[Check] = essential.BITONIC.listed  # where a run may sort so
BY_NAME = {check.name: check for check in (*KERNELS, *SPEED, *ESSENTIAL, *BITONIC)}
