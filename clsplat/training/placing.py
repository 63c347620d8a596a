"""Where the harmonics of a training lie: on the device, or on the host."""

import logging

from clsplat.gaussians.tables import moment_tables
from clsplat.training.memory import last_place
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


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
