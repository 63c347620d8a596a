"""How far a piece of work on the host is: a line of the log now and then, and whoever else listens."""

import contextvars
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol, TypeVar

from clsplat.core.errors import Interrupted

LOG = logging.getLogger("clsplat")
Item = TypeVar("Item")
INTERVAL = 5.0  # seconds between lines of the log
WATCH, SLOWEST = 0.5, 5.0  # seconds between two looks at work that does not count by itself: at first, and at most
LOOKS = 40  # in the time that has passed, at most, for a look may cost a process


class Listener(Protocol):
    """Hears what is counted, how many are done, how many there are, and the time left, where that is known."""

    def __call__(self, what: str, done: int, total: int, /, *, seconds_left: float | None) -> None: ...


_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
_level: ContextVar[int] = ContextVar("level", default=logging.INFO)  # of the lines of counts


@contextmanager
def log_level(level: int) -> Iterator[None]:
    """Leave out what the block tells below a level of `logging`: who calls it says the same in other words."""
    before = LOG.level
    LOG.setLevel(level)
    try:
        yield
    finally:
        LOG.setLevel(before)


@contextmanager
def captured_log(level: int) -> Iterator[list[str]]:
    """Collect what the block tells from a level of `logging` on, in the place of telling it: it is shown elsewhere."""
    told: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        told.append(record.getMessage())
        return False

    with log_level(level):
        LOG.addFilter(keep)
        try:
            yield told
        finally:
            LOG.removeFilter(keep)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Call `listener` for each step of the work in this block, beside those of blocks around it.

    It is called from the thread of the block, or of a `polled` one.
    """
    around = _listener.get()

    def both(what: str, done: int, total: int, /, *, seconds_left: float | None) -> None:
        for one in filter(None, (around, listener)):
            one(what, done, total, seconds_left=seconds_left)

    token = _listener.set(both)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def counts_as_debug() -> Iterator[None]:
    """Log the counts of the block as details: something else shows them."""
    token = _level.set(logging.DEBUG)
    try:
        yield
    finally:
        _level.reset(token)


class Count:
    """Counts the pieces of some work: `what` is what is done, such as 'photographs decoded'."""

    def __init__(self, what: str, total: int, is_even: bool = True) -> None:
        """is_even: whether pieces take about the same time, so that the time left follows from those done."""
        self.what, self.total, self.done, self.is_even = what, total, 0, is_even
        self._began: tuple[float, int] | None = None  # when, and with how many done by an earlier call
        self._logged = time.monotonic()
        self.reach(0)

    @property
    def seconds_left(self) -> float | None:
        """The time that the other pieces take at the speed of those done so far; None before the first."""
        if not self.is_even or self._began is None or self.done <= self._began[1]:
            return None
        began, before = self._began
        return (time.monotonic() - began) / (self.done - before) * (self.total - self.done)

    def reach(self, done: int) -> None:
        """Note how many pieces are done; nobody hears of nothing."""
        self.done = done
        if not self.total:
            return
        if self._began is None or self.done < self._began[1]:
            self._began = time.monotonic(), done
        left = self.seconds_left
        if listener := _listener.get():
            listener(self.what, done, self.total, seconds_left=left)
        if done and time.monotonic() - self._logged >= INTERVAL:
            self._logged = time.monotonic()
            told = f", {clock(left)} left" if left else ""
            LOG.log(_level.get(), "%s: %d of %d%s", self.what, done, self.total, told)


def counted(items: Iterable[Item], what: str, total: int) -> Iterator[Item]:
    """Yield the items and count them; what was yielded is done when the next is asked for."""
    count = Count(what, total)
    for number, item in enumerate(items, 1):
        yield item
        count.reach(number)


@contextmanager
def polled(count: Count, look: Callable[[], int]) -> Iterator[None]:
    """Count work that does not count by itself: a thread looks now and then how many pieces are done."""
    ended, context = threading.Event(), contextvars.copy_context()

    def watch() -> None:
        began = time.monotonic()
        while not ended.wait(min(max(WATCH, (time.monotonic() - began) / LOOKS), SLOWEST)):
            done = look()
            if done > count.done:
                count.reach(min(done, count.total))

    thread = threading.Thread(target=context.run, args=(watch,), name="count", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def clock(seconds: float) -> str:
    """Return a time as h:mm:ss, or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Stopped(Interrupted):
    """A stage has ended before its end, since the run is to stop; it is repeated when the run goes on."""


@dataclass(frozen=True)
class Progress:
    """The state of training, for the terminal."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, the mean over the training views of the last reports, before 8 bits
    gaussians: int | None  # None: what is trained are none
    milliseconds: float  # per step
    seconds_left: float
    growth_known: bool = True  # False: rules will make steps slower, and it is not known yet how much
