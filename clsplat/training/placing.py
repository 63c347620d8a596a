"""Where the harmonics of a training lie: on the device, or on the host."""

import logging

from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


def place_harmonics(run: Run) -> None:
    """Move the harmonics to the host where the settings say so.

    They come before Adam's moments of them, which make the larger part.
    """
    gaussians = run.model.gaussians
    if run.harmonics == "host" and gaussians.on_host is None:
        gaussians.move_to_host()
        LOG.info("the harmonics lie on the host, and the device has those that a view sees: the same bits, slower")
