"""Where the harmonics of a training lie: on the device, or on the host."""

import logging
import math

from clsplat.gaussians.sh_offload import GROWTH, NO_SLOT
from clsplat.gaussians.structs import moment_tables
from clsplat.training.memory import SEEN_SHARE, MemoryPlan, Where, last_place
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
NEAR = 2  # times as many Gaussians: an edit makes few more of them
VIEWS = 16  # that are looked at


def place_harmonics(run: Run) -> None:
    """Move the harmonics to the host before a training, where the settings say so, or where only that holds it.

    They come before Adam's moments of them, which make the larger part.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host is None and gaussians.count <= most_gaussians(run, gaussians.count):
        make_room(run, gaussians.count)


def make_room(run: Run, count: int) -> None:
    """Move the harmonics to the host where the device does not hold `count` Gaussians with all of theirs.

    Bits do not depend on when they move.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host or last_place(run.harmonics, run.device.info) == "device":
        return
    why = ""
    if run.harmonics == "auto":
        if count <= (held := _plan(run, "device").limit):
            return
        why = f", as the device holds {held:,} Gaussians with all of theirs"
    gaussians.move_to_host()
    told = f"the harmonics lie on the host{why}, and the device has those that a view sees"
    LOG.info("step %d: %s: the same bits, slower", run.step, told)


def most_gaussians(run: Run, asked: float = math.inf) -> int:
    """Return how many Gaussians the device holds at most, with the harmonics where they may lie at last.

    With `auto` it depends on the Gaussians alone, and not on where their harmonics are: what some training views see of
    them must leave more room on the host.  Those that are there stay.  asked: as many are enough.
    """
    place = last_place(run.harmonics, run.device.info)
    held = _plan(run, place if run.harmonics == "host" else "device").limit
    if run.harmonics != "auto" or place == "device" or min(asked, NEAR * run.model.gaussians.count) <= held:
        return held
    there = run.model.gaussians.count if run.stage_step else 0
    return max(held, there, _plan(run, "host", _seen(run)).limit)


def more_room(run: Run) -> str:
    """Return what makes room, in words that follow others, where the settings keep the harmonics on the device."""
    helps = run.pipeline["rasterizer"]["harmonics"] == "device" and not run.device.info.unified
    return ", or rasterizer.harmonics=auto" if helps else ""


def _plan(run: Run, harmonics: Where, seen: float = SEEN_SHARE) -> MemoryPlan:
    """The plan with Adam's moments, whether they are there already or not."""
    widths, trained = run.model.gaussians.components, run.model.gaussians.trained
    moments = {moment: widths[name] for name in trained for moment in moment_tables(name)}
    return run.memory_plan({**widths, **moments}, harmonics, seen)


def _seen(run: Run) -> float:
    """The largest share of the blocks of rows that one of some training views sees, with room for more."""
    survey, gaussians = run.survey(), run.model.gaussians
    lanes, most = int(run.device.tuning["LANES"]), 0.0
    for look in survey.render(survey.sample_views(VIEWS)):
        keys = look.frame.depth_key.get()[: gaussians.count // lanes * lanes]
        most = max(most, float((keys != NO_SLOT).reshape(-1, lanes).any(axis=1).mean()))
    return GROWTH * most
