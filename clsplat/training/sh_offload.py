"""Offload the harmonics of a training to the host, if the device cannot hold them."""

import logging
import math

from clsplat.gaussians.sh_offload import GROWTH, NO_SLOT
from clsplat.gaussians.structs import moment_tables
from clsplat.training.memory import VISIBLE_FRACTION, Location, MemoryPlan, offload_target
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
FACTOR = 2  # on the number of Gaussians; an edit rarely adds more
VIEWS = 16  # rendered to measure how many Gaussians a view sees


def offload_harmonics(run: Run) -> None:
    """Move the harmonics to the host before a training, if the settings require it or the device is too small.

    Must be called before Adam allocates their moments, which are larger.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host is None and gaussians.count <= device_capacity(run, gaussians.count):
        make_room(run, gaussians.count)


def make_room(run: Run, count: int) -> None:
    """Move the harmonics to the host if the device cannot hold those of `count` Gaussians.  Bits stay the same."""
    gaussians = run.model.gaussians
    if gaussians.on_host or offload_target(run.harmonics, run.device.info) == "device":
        return
    reason = ""
    if run.harmonics == "auto":
        if count <= (capacity := _plan(run, "device").limit):
            return
        reason = f", since the device can hold only {capacity:,} Gaussians with harmonics"
    gaussians.move_to_host()
    LOG.info("step %d: harmonics move to the host%s; training slows down, with the same bits", run.step, reason)


def device_capacity(run: Run, needed: float = math.inf) -> int:
    """Return how many Gaussians fit on the device, with harmonics offloaded if that is allowed and helps.

    With `auto`, the result depends only on the Gaussians, not on where their harmonics are now.  needed: the number of
    Gaussians that suffices, so that the search may stop.
    """
    location = offload_target(run.harmonics, run.device.info)
    capacity = _plan(run, location if run.harmonics == "host" else "device").limit
    if run.harmonics != "auto" or location == "device" or min(needed, FACTOR * run.model.gaussians.count) <= capacity:
        return capacity
    current = run.model.gaussians.count if run.stage_step else 0
    return max(capacity, current, _plan(run, "host", _visible_fraction(run)).limit)


def offload_advice(run: Run) -> str:
    """Return a further remedy for an error message if the settings keep harmonics on the device, else ""."""
    helps = run.pipeline["rasterizer"]["harmonics"] == "device" and not run.device.info.unified
    return ", or rasterizer.harmonics=auto" if helps else ""


def _plan(run: Run, harmonics: Location, visible: float = VISIBLE_FRACTION) -> MemoryPlan:
    """Return the memory plan including Adam moments, even if they are not allocated yet."""
    widths, trained = run.model.gaussians.components, run.model.gaussians.trained
    moments = {moment: widths[name] for name in trained for moment in moment_tables(name)}
    return run.memory_plan({**widths, **moments}, harmonics, visible)


def _visible_fraction(run: Run) -> float:
    """Return the largest fraction of row blocks visible in one of VIEWS training views, with a margin."""
    survey, gaussians = run.survey(), run.model.gaussians
    lanes, largest = int(run.device.tuning["LANES"]), 0.0
    for view in survey.render(survey.sample_views(VIEWS)):
        keys = view.frame.depth_key.get()[: gaussians.count // lanes * lanes]
        largest = max(largest, float((keys != NO_SLOT).reshape(-1, lanes).any(axis=1).mean()))
    return GROWTH * largest
