"""Offload spherical harmonics to the host during training if they do not fit on the device."""

import logging
import math

from clsplat.gaussians.sh_offload import GROWTH, NO_SLOT
from clsplat.gaussians.structs import moment_tables
from clsplat.training.memory import VISIBLE_FRACTION, Location, MemoryPlan, offload_target
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
GROWTH_FACTOR = 2  # largest expected growth of the number of Gaussians in an edit
VIEWS = 16  # number of views rendered to measure the fraction of visible Gaussians


def offload_harmonics(run: Run) -> None:
    """Move the harmonics to the host before training if the settings require it, or if they do not fit on the device.

    Call this before Adam allocates their moments, which need twice the memory of the harmonics.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host is None and gaussians.count <= device_capacity(run, gaussians.count):
        make_room(run, gaussians.count)


def make_room(run: Run, count: int) -> None:
    """Move the harmonics to the host if those of `count` Gaussians do not fit on the device.  Results do not change."""
    gaussians = run.model.gaussians
    if gaussians.on_host or offload_target(run.harmonics, run.device.info) == "device":
        return
    reason = ""
    if run.harmonics == "auto":
        if count <= (capacity := _plan(run, "device").limit):
            return
        reason = f", since the device can hold only {capacity:,} Gaussians with harmonics"
    gaussians.move_to_host()
    LOG.info(
        "step %d: moving SH coefficients to the host%s; training slows down, but its results stay bit-identical",
        run.step,
        reason,
    )


def device_capacity(run: Run, required: float = math.inf) -> int:
    """Return the number of Gaussians that fit on the device, with offloaded harmonics if the settings allow it.

    With `auto`, the result does not depend on where the harmonics are now.  required: number of Gaussians that must
    fit; if they fit without offloading, the fraction of visible Gaussians is not measured.
    """
    location = offload_target(run.harmonics, run.device.info)
    capacity = _plan(run, location if run.harmonics == "host" else "device").limit
    wanted = min(required, GROWTH_FACTOR * run.model.gaussians.count)
    if run.harmonics != "auto" or location == "device" or wanted <= capacity:
        return capacity
    current = run.model.gaussians.count if run.stage_step else 0
    return max(capacity, current, _plan(run, "host", _visible_fraction(run)).limit)


def offload_advice(run: Run) -> str:
    """Return the advice to offload harmonics, as the end of an error message; "" if it would not help."""
    is_helpful = run.pipeline["rasterizer"]["harmonics"] == "device" and not run.device.info.unified
    return ", or rasterizer.harmonics=auto" if is_helpful else ""


def _plan(run: Run, harmonics: Location, visible: float = VISIBLE_FRACTION) -> MemoryPlan:
    """Return the memory plan, including Adam moments that are not allocated yet."""
    widths, trained_names = run.model.gaussians.components, run.model.gaussians.trained
    moments = {moment: widths[name] for name in trained_names for moment in moment_tables(name)}
    return run.memory_plan({**widths, **moments}, harmonics, visible)


def _visible_fraction(run: Run) -> float:
    """Return the largest fraction of row blocks visible in one view, over VIEWS training views, with a margin."""
    survey, gaussians = run.survey(), run.model.gaussians
    lanes, max_fraction = int(run.device.tuning["LANES"]), 0.0
    for view in survey.render(survey.sample_views(VIEWS)):
        keys = view.frame.depth_key.get()[: gaussians.count // lanes * lanes]
        max_fraction = max(max_fraction, float((keys != NO_SLOT).reshape(-1, lanes).any(axis=1).mean()))
    return GROWTH * max_fraction
