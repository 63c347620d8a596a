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
        failure = as_clsplat_error(error)
        with suppress(OutputError):  # the failure itself is more important
            state: Literal["interrupted", "failed"] = "interrupted" if isinstance(failure, Interrupted) else "failed"
            status.end(state, failure.exit_code, one_line(failure))
        if failure is error or as_raised:
            raise
        raise failure from error
