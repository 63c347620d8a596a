"""Where the harmonics of a training lie: on the device, or on the host."""

import logging

from clsplat.formats.motion import MOTION
from clsplat.training.memory import first_tables
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


def place_harmonics(run: Run) -> bool:
    """Move the harmonics to the host where the settings, or the plan of memory, say so; return whether they lie there.

    They come before Adam's moments of them, which make the larger part.
    """
    gaussians = run.model.gaussians
    if gaussians.on_host is None:
        present = gaussians.components
        planned = run.memory_plan(first_tables(gaussians.sh_degree, present.get(MOTION, 0)) | present)
        if planned.beginning_with(gaussians.count).host:
            gaussians.move_to_host()
            LOG.info("the harmonics lie on the host, and the device has those that a view sees: the same bits, slower")
    return gaussians.on_host is not None
