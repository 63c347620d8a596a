"""Record the failure of a run in its status.json, and collect the failures of parts, such as the cells of a matrix."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Literal

from clsplat.core.errors import ClsplatError, Interrupted, OutputError, as_clsplat_error, one_line, shell_quote
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")


class Failures(dict[str, ClsplatError]):
    """A dictionary from the name of each failed part to its error."""

    def __init__(self, plural: str) -> None:
        """plural: the noun for the parts in messages, such as "cells"."""
        super().__init__()
        self._plural = plural

    @contextmanager
    def recording(self, name: str) -> Iterator[None]:
        """Record an error in the block as the failure of a part, instead of raising it.  Interrupted is not caught."""
        try:
            yield
        except Interrupted:
            raise
        except Exception as error:
            self.note(name, as_clsplat_error(error))

    def note(self, name: str, error: ClsplatError) -> None:
        """Record the error of a part, and log it."""
        self[name] = error
        LOG.warning("%s failed: %s", name, one_line(error))

    def messages(self) -> dict[str, str]:
        """Return the error of each part as one line, by name."""
        return {name: one_line(error) for name, error in self.items()}

    def summary(self, count: int, verb: str = "failed") -> ClsplatError:
        """Return a single error with the exit code of the first failure.  count: total number of parts."""
        name, first_error = next(iter(self.items()))
        error = ClsplatError(f"{len(self)} of {count} {self._plural} {verb}; the first, {name}: {first_error}")
        error.exit_code = first_error.exit_code
        return error


@contextmanager
def recording_failures(status: StatusFile, reraise: bool = False) -> Iterator[None]:
    """Write any failure in the block to status.json, and raise it as a ClsplatError.

    reraise: whether to raise the original exception instead.
    """
    try:
        yield
    except BaseException as error:
        is_interrupt = isinstance(error, KeyboardInterrupt) and not reraise
        failure = _interrupted_error(status) if is_interrupt else as_clsplat_error(error)
        with suppress(OutputError):  # the failure itself is more important
            state: Literal["interrupted", "failed"] = "interrupted" if isinstance(failure, Interrupted) else "failed"
            status.end(state, failure.exit_code, one_line(failure))
        if failure is error or reraise:
            raise
        raise failure from error


def _interrupted_error(status: StatusFile) -> Interrupted:
    """Return the error of a run that a signal stopped at once, with advice on how to continue."""
    now, resume = status.now, f"`clsplat resume {shell_quote(status.out)}`"
    if not (status.has_run and now.step):  # the folder is unchanged
        return Interrupted("stopped at once; run the same command again to continue")
    if now.checkpoint:
        return Interrupted(f"stopped at once; {resume} continues from {now.checkpoint}")
    return Interrupted(f"stopped at once, and no checkpoint was saved; {resume} starts it over")
