"""dropout.cl: what a step leaves out, and what projection makes of the others."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.projection import COUNTS, gradient_figures, record_figures, splats_of
from clsplat.conformance.comparison import Figure, equal
from clsplat.conformance.scenes import Case, random_case, with_world_filter
from clsplat.gaussians.left_out import hide
from clsplat.gaussians.tables import Dropout
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer

CHECKS = Checks()
SEED, STEP = 0x9E3779B9, 700
DROPOUT = Dropout(0.3, SEED, STEP)


def dropout_figures(device: Device, case: Case, rng: np.random.Generator, what: str) -> Iterator[Figure]:
    """Compare the records, and the gradients of the parameters, of a step that leaves Gaussians out."""
    yield from record_figures(device, case, what)
    yield from gradient_figures(device, case, rng, what)


def hidden_figures(device: Device, case: Case, rng: np.random.Generator) -> Iterator[Figure]:
    """Hide Gaussians in a view of which others are dropped; the records are those without both."""
    model, camera, count = case.model(device), case.device_camera(device), len(case.parameters["means"])
    left_out = rng.random((2, count)) < 0.5
    hide(model.gaussians, left_out)
    found = Rasterizer(device, "radix").forward(model, replace(camera, view=1), device.zeros(3)).splats.get()
    expected, _, _ = splats_of(device, case)
    expected[left_out[1]] = 0
    yield equal("draw_left_out", f"records of {count} Gaussians, some dropped and some hidden", found, expected)


@CHECKS.add("draw_left_out", "project_forward", "project_backward")
def dropout(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count in COUNTS:
        case = replace(random_case(rng, count), dropout=DROPOUT)
        yield from dropout_figures(device, case, rng, f"{count} Gaussians, some dropped")
        yield from hidden_figures(device, case, rng)
    filtered = with_world_filter(random_case(rng, 30, variance=0.1, compensate=1.0), rng)
    yield from dropout_figures(device, replace(filtered, dropout=DROPOUT), rng, "30 filtered Gaussians, some dropped")
