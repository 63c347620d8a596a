"""Where the harmonics of a training lie: on the device, or on the host."""

import logging

from clsplat.gaussians.on_host import GROWTH, NO_SLOT
from clsplat.gaussians.tables import moment_tables
from clsplat.training.memory import last_place
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
NEAR = 2  # times as many Gaussians: an edit makes few more of them
VIEWS = 16  # that are looked at


def most_gaussians(run: Run) -> int:
    """Return how many Gaussians the device holds at most, with the harmonics where they may lie at last.

    With `auto` it depends on the Gaussians alone, and not on where their harmonics are: what some training views see of
    them must leave more room on the host.
    """
    place = last_place(run.harmonics, run.device.info)
    if run.harmonics != "auto" or place == "device":
        return run.memory_plan(harmonics=place).limit
    held = run.memory_plan(harmonics="device").limit
    if NEAR * run.model.gaussians.count <= held:
        return held
    return max(held, run.memory_plan(harmonics="host", seen=_seen(run)).limit)


def _seen(run: Run) -> float:
    """The largest share of the blocks of rows that one of some training views sees, with room for more."""
    survey, gaussians = run.survey(), run.model.gaussians
    lanes, most = int(run.device.tuning["LANES"]), 0.0
    for look in survey.looks(survey.drawn(VIEWS)):
        keys = look.frame.depth_key.get()[: gaussians.count // lanes * lanes]
        most = max(most, float((keys != NO_SLOT).reshape(-1, lanes).any(axis=1).mean()))
    return GROWTH * most


def make_room(run: Run, count: int) -> None:
    """Move the harmonics to the host where the settings say so, or where the device does not hold `count` Gaussians.

    Bits do not depend on when they move.  Before the moments are there, theirs count too.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host or last_place(run.harmonics, run.device.info) == "device":
        return
    if run.harmonics == "auto":
        widths = gaussians.components
        moments = {moment: widths[name] for name in gaussians.trained for moment in moment_tables(name)}
        if count <= (held := run.memory_plan({**widths, **moments}, "device").limit):
            return
        why = f", as the device holds {held:,} Gaussians with all of theirs"
    else:
        why = ""
    gaussians.move_to_host()
    told = f"the harmonics lie on the host{why}, and the device has those that a view sees"
    LOG.info("step %d: %s: the same bits, slower", run.step, told)
