"""Offload the harmonics of a training to the host, if the device cannot hold them."""

import logging
import math

from clsplat.gaussians.sh_offload import GROWTH, NO_SLOT
from clsplat.gaussians.structs import moment_tables
from clsplat.training.memory import SEEN_SHARE, MemoryPlan, Where, last_place
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
NEAR = 2  # factor of the number of Gaussians; an edit seldom adds more
VIEWS = 16  # rendered to measure how many Gaussians a view sees


def place_harmonics(run: Run) -> None:
    """Move the harmonics to the host before a training, if the settings require it or the device is too small.

    It must happen before Adam allocates their moments, which are larger.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host is None and gaussians.count <= most_gaussians(run, gaussians.count):
        make_room(run, gaussians.count)


def make_room(run: Run, count: int) -> None:
    """Move the harmonics to the host if the device cannot hold those of `count` Gaussians.  Bits stay the same."""
    gaussians = run.model.gaussians
    if gaussians.on_host or last_place(run.harmonics, run.device.info) == "device":
        return
    why = ""
    if run.harmonics == "auto":
        if count <= (capacity := _plan(run, "device").limit):
            return
        why = f", since the device can hold only {capacity:,} Gaussians with harmonics"
    gaussians.move_to_host()
    LOG.info("step %d: harmonics move to the host%s: the same bits, but slower", run.step, why)


def most_gaussians(run: Run, asked: float = math.inf) -> int:
    """Return how many Gaussians the device can hold, with harmonics offloaded if that is allowed and helps.

    With `auto`, the result depends only on the Gaussians, not on where their harmonics are now.  asked: the search may
    stop at this number.
    """
    location = last_place(run.harmonics, run.device.info)
    capacity = _plan(run, location if run.harmonics == "host" else "device").limit
    if run.harmonics != "auto" or location == "device" or min(asked, NEAR * run.model.gaussians.count) <= capacity:
        return capacity
    there = run.model.gaussians.count if run.stage_step else 0
    return max(capacity, there, _plan(run, "host", _seen(run)).limit)


def more_room(run: Run) -> str:
    """Return a further remedy for an error message, if the settings keep the harmonics on the device."""
    helps = run.pipeline["rasterizer"]["harmonics"] == "device" and not run.device.info.unified
    return ", or rasterizer.harmonics=auto" if helps else ""


def _plan(run: Run, harmonics: Where, seen: float = SEEN_SHARE) -> MemoryPlan:
    """Return the memory plan including Adam moments, even if they are not allocated yet."""
    widths, trained = run.model.gaussians.components, run.model.gaussians.trained
    moments = {moment: widths[name] for name in trained for moment in moment_tables(name)}
    return run.memory_plan({**widths, **moments}, harmonics, seen)


def _seen(run: Run) -> float:
    """Return the largest share of row blocks that one of some training views sees, with a margin."""
    survey, gaussians = run.survey(), run.model.gaussians
    lanes, most = int(run.device.tuning["LANES"]), 0.0
    for look in survey.render(survey.sample_views(VIEWS)):
        keys = look.frame.depth_key.get()[: gaussians.count // lanes * lanes]
        most = max(most, float((keys != NO_SLOT).reshape(-1, lanes).any(axis=1).mean()))
    return GROWTH * most
