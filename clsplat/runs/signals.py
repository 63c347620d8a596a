"""What a run does on Ctrl-C, SIGTERM and SIGHUP."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from clsplat.signals import stop_at_once, stopping_on_signals
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


@contextmanager
def finishing_on_interrupt(run: Run) -> Iterator[None]:
    """Finish the step, or the view of a longer stage, and save the state at the first signal.

    The second signal stops at once, and so does the first where there is no model to save.
    """

    def finish() -> None:
        if run.interrupted or not run.has_model:
            stop_at_once()
            return
        run.interrupted = True
        LOG.info("finishing the step; press Ctrl-C again to stop at once")

    with stopping_on_signals(finish):
        yield
