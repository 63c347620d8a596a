"""Record failures: of a run, in its status.json, and of parts, such as cells, without which the rest continues."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Literal

from clsplat.core.errors import ClsplatError, Interrupted, OutputError, as_clsplat_error, one_line, shell_quote
from clsplat.training.status import StatusFile

LOG = logging.getLogger("clsplat")


class Failures(dict[str, ClsplatError]):
    """The parts that failed, by their names."""

    def __init__(self, parts: str) -> None:
        """parts: their name in messages, such as cells."""
        super().__init__()
        self._parts = parts

    @contextmanager
    def kept(self, name: str) -> Iterator[None]:
        """Record a failure of the block as that of a part, without raising it.  Raises Interrupted."""
        try:
            yield
        except Interrupted:
            raise
        except Exception as error:
            self.note(name, as_clsplat_error(error))

    def note(self, name: str, error: ClsplatError) -> None:
        """Record and log that a part failed."""
        self[name] = error
        LOG.warning("%s failed: %s", name, one_line(error))

    def texts(self) -> dict[str, str]:
        """Return the error of each part in one line."""
        return {name: one_line(error) for name, error in self.items()}

    def whole(self, count: int, what: str = "failed") -> ClsplatError:
        """Return one error for all, with the exit code of the first.  count: number of all parts."""
        name, first = next(iter(self.items()))
        whole = ClsplatError(f"{len(self)} of {count} {self._parts} {what}; the first, {name}: {first}")
        whole.exit_code = first.exit_code
        return whole


@contextmanager
def failures_recorded(status: StatusFile, as_raised: bool = False) -> Iterator[None]:
    """Turn any failure of the block into a ClsplatError, and write it to status.json.

    as_raised: raise the failure itself instead.
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
    """Return the error of a run that a signal ended at once, with how to continue it."""
    now, resume = status.now, f"`clsplat resume {shell_quote(status.out)}`"
    if not (status.has_run and now.step):  # its folder is as it was before
        return Interrupted("stopped at once; run the same command again to continue")
    if now.checkpoint:
        return Interrupted(f"stopped at once; {resume} continues from {now.checkpoint}")
    return Interrupted(f"stopped at once, and no checkpoint was saved; {resume} starts it over")
