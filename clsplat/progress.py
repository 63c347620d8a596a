"""How far a piece of work on the host is: a line of the log now and then, and whoever else listens."""

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

LOG = logging.getLogger("clsplat")
INTERVAL = 5.0  # seconds between lines of the log

Item = TypeVar("Item")
Listener = Callable[[str, int, int], None]  # what is counted, how many are done, how many there are
_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def heard_by(listener: Listener) -> Iterator[None]:
    """Call `listener` for each step of the work in this block; it is called from the thread of the block."""
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


class Count:
    """Counts the pieces of some work: `what` is what is done, such as 'photographs decoded'."""

    def __init__(self, what: str, total: int) -> None:
        self.what, self.total, self.done = what, total, 0
        self._begun = self._logged = time.monotonic()
        self.reach(0)

    def reach(self, done: int) -> None:
        """Note how many pieces are done."""
        self.done = done
        if listener := _listener.get():
            listener(self.what, done, self.total)
        if done and time.monotonic() - self._logged >= INTERVAL:
            self._logged = time.monotonic()
            left = (self._logged - self._begun) / done * (self.total - done)
            LOG.info("%s: %d of %d, about %s left", self.what, done, self.total, clock(left))


def counted(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield the items and count them; what was yielded is done when the next is asked for."""
    count = Count(what, total)
    for number, item in enumerate(items, 1):
        yield item
        count.reach(number)


def clock(seconds: float) -> str:
    """Return a time as 0:07 or 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
