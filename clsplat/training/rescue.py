"""Save the state of a run that fails."""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager

from clsplat.errors import Interrupted, NotFiniteError, one_line
from clsplat.losses.base import ViewLosses
from clsplat.losses.image import psnr
from clsplat.training import checkpoint
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


@contextmanager
def saved_on_failure(run: Run) -> Iterator[None]:
    """Where the block fails, save the state of the last whole step, and tell where it is; the failure is raised."""
    try:
        yield
    except (Interrupted, NotFiniteError):  # saved already, or set aside
        raise
    except (Exception, SystemExit, GeneratorExit):  # what a plug-in may raise; a second Ctrl-C stops at once
        if run.step > 0 and not run.status.lost:
            LOG.warning(_rescue(run))
        raise


def finite_values(run: Run, view: str, losses: ViewLosses) -> tuple[float, float]:
    """Read the loss and the PSNR, dB, of a step at a view.

    Raises NotFiniteError, with the state set aside, where the loss or the model is not finite.
    """
    broken, loss = run.not_finite(), losses.loss
    if broken or not math.isfinite(loss):
        told = checkpoint.set_aside(run, broken)
        raise NotFiniteError(f"step {run.step}, view '{view}': the loss is {loss}; {told}")
    return loss, psnr(losses.comparison)


def _rescue(run: Run) -> str:
    """Save the state where it is whole; return a sentence about it."""
    try:
        if run.whole and not run.not_finite() and run.gaussians != 0:
            return f"the state of step {run.step} is saved in {checkpoint.save(run)}; `clsplat resume` goes on from it"
        why = "the step that failed was not whole" if not run.whole else "the model is not finite"
    except Exception as error:  # the failure itself is what the user must see
        why = f"the state could not be saved ({one_line(error)})"
    files = checkpoint.saved(run.out)
    return f"{why}; {f'the last good state is {files[-1]}' if files else 'no state was saved before'}"
