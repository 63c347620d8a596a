"""Averages of the parameters over steps."""

from collections.abc import Iterator

import numpy as np

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.comparison import SUM, Figure, by_element
from clsplat.conformance.scenes import random_case
from clsplat.gaussians.tables import PARAMETERS
from clsplat.opencl.device import Device
from clsplat.training import average

CHECKS = Checks()
COUNTS = (1, 15, 17, 65)


@CHECKS.add("add_to_average", "count_step", "take_average")
def averages(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count in COUNTS:
        yield from average_figures(device, rng, count)


def average_figures(device: Device, rng: np.random.Generator, count: int) -> Iterator[Figure]:
    """The average of three steps, where the last row, if it is not the only one, is new after the first step."""
    steps = [random_case(rng, count).parameters for _ in range(3)]
    gaussians = random_case(rng, count).model(device).gaussians
    average.attach(gaussians)
    for step, parameters in enumerate(steps):
        for name in PARAMETERS:
            gaussians.set(name, parameters[name])
        average.add(gaussians)
        if step == 0 and count > 1:
            source, fresh = np.arange(count, dtype=np.uint32), np.zeros(count, np.uint32)
            fresh[-1] = 1
            gaussians.rearrange(device.upload(source), device.upload(fresh), count)
    for name in PARAMETERS:
        gaussians.set(name, steps[0][name])
    average.take(gaussians)
    for name in PARAMETERS:
        values = np.stack([parameters[name].astype(np.float64) for parameters in steps])
        expected = values.mean(axis=0)
        expected[-1] = values[1 if count > 1 else 0 :, -1].mean(axis=0)
        found = gaussians.get(name)
        yield by_element("take_average", f"average of {name}, {count} Gaussians", found, expected, SUM, floor=1)
