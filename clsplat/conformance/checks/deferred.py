"""Updates of harmonics that wait until a view sees their Gaussians."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance import reference as ref
from clsplat.conformance.check import Checks, Note
from clsplat.conformance.checks.blending import BACKGROUND
from clsplat.conformance.comparison import SUM, Figure, by_element, equal
from clsplat.conformance.scenes import random_case
from clsplat.gaussians.deferred import Deferred
from clsplat.gaussians.tables import DeviceModel, Gradients
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates, Rows

CHECKS = Checks()
COUNTS = (1, 15, 17, 65, 150)
CULLED = 0xFFFFFFFF
LONGEST = 5  # below the number of steps, so that the list is full once
STEPS = 8


def seen_rows(rng: np.random.Generator, count: int) -> NDArray[np.bool_]:
    """Return which rows a view sees: few, in few of the blocks of 16."""
    blocks = rng.random(-(-count // 16)) < 0.4
    return blocks.repeat(16)[:count] & (rng.random(count) < 0.5)


def trained(
    device: Device, model: DeviceModel, seen: list[NDArray[np.bool_]], gradients: list[NDArray[np.float32]], rows: Rows
) -> dict[str, NDArray[np.float32]]:
    """Update a model once for each view, and return the harmonics and their moments.

    seen: [N] rows in the view; gradients: [N, components] of the harmonics.
    """
    gaussians, adam = model.gaussians, Adam(model.gaussians)
    camera = random_case(np.random.default_rng(0), 1).device_camera(device)
    frame = Rasterizer(device, "radix").forward(model, camera, device.upload(BACKGROUND))
    deferred = gaussians.deferred = Deferred(gaussians, LONGEST) if rows == "deferred" else None
    for step, (mask, gradient) in enumerate(zip(seen, gradients, strict=True), 1):
        keys = np.full(gaussians.capacity, CULLED, np.uint32)
        keys[: gaussians.count][mask] = 7
        of_view = replace(frame, depth_key=device.upload(keys))
        of_loss = Gradients(gaussians)
        planes = np.zeros(of_loss["sh_rest"].shape, np.float32)
        planes[:, : gaussians.count] = gradient.T
        of_loss["sh_rest"].set(planes)
        if deferred:
            deferred.catch_up(of_view.depth_key)
        others = set(gaussians.trained) - {"sh_rest"}
        adam.step(model, of_view, of_loss, Rates().at(step, extent=2.0), others, rows)
    return {name: gaussians.get(name) for name in Deferred.names}


def deferred_figures(device: Device, rng: np.random.Generator, count: int) -> Iterator[Figure]:
    """Compare waiting updates with the reference, and with the bits of updates at once."""
    case = random_case(rng, count)
    before = case.parameters["sh_rest"]
    seen = [seen_rows(rng, count) for _ in range(STEPS)]
    gradients = [rng.normal(size=before.shape).astype(np.float32) * mask[:, None] for mask in seen]
    values, moment1, moment2 = before.astype(np.float64), np.zeros(before.shape), np.zeros(before.shape)
    for step, gradient in enumerate(gradients, 1):
        rate = Rates().at(step, extent=2.0)["sh_rest"]
        values, moment1, moment2 = ref.adam_step(values, gradient.astype(np.float64), moment1, moment2, step, rate)
    found = trained(device, case.model(device), seen, gradients, "deferred")
    at_once = trained(device, case.model(device), seen, gradients, "all")
    moved = max(float(np.abs(values - before).max(initial=0)), 1e-6)
    yield by_element("replay_updates", f"{count} Gaussians", found["sh_rest"], values, 3e-7, 2e-5 * moved / 3e-7)
    for name, expected, bound in zip(Deferred.names[1:], (moment1, moment2), (SUM, 3 * SUM), strict=True):
        floor = 0.1 * float(np.abs(expected).max(initial=0))
        yield by_element("replay_updates", f"{name}, {count} Gaussians", found[name], expected, bound, floor)
    for name in Deferred.names:
        bits, expected_bits = found[name].view(np.uint32), at_once[name].view(np.uint32)
        yield equal("note_update", f"bits of {name}, {count} Gaussians", bits, expected_bits)


@CHECKS.add("replay_updates", "note_update", "adam_step")
def updates_that_wait(device: Device, rng: np.random.Generator) -> Iterator[Figure | Note]:
    for count in COUNTS:
        yield from deferred_figures(device, rng, count)
