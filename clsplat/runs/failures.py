"""Failures of a run, as its status.json tells them."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Literal

from clsplat.errors import Interrupted, OutputError, as_clsplat_error, one_line
from clsplat.training.status import StatusFile


@contextmanager
def failures_recorded(status: StatusFile, as_raised: bool = False) -> Iterator[None]:
    """Turn every failure of the block into a ClsplatError, and write it to status.json.

    With `as_raised` the failure itself is raised.
    """
    try:
        yield
    except BaseException as error:
        is_stopped = isinstance(error, KeyboardInterrupt) and not as_raised
        failure = _stopped(status) if is_stopped else as_clsplat_error(error)
        with suppress(OutputError):  # the failure itself is more important
            state: Literal["interrupted", "failed"] = "interrupted" if isinstance(failure, Interrupted) else "failed"
            status.end(state, failure.exit_code, one_line(failure))
        if failure is error or as_raised:
            raise
        raise failure from error


def _stopped(status: StatusFile) -> Interrupted:
    """What to tell of a run that a signal ended at once, and how it goes on."""
    now, resume = status.now, f"`clsplat resume {status.out}`"
    if not (status.has_run and now.step):  # its folder is as it was before
        return Interrupted("stopped at once; to go on, run the same command again")
    if now.checkpoint:
        return Interrupted(f"stopped at once; {resume} goes on from {now.checkpoint}")
    return Interrupted(f"stopped at once, and no checkpoint was saved; {resume} begins it again")
