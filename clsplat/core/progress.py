"""Report the progress of work on the host, with a log line every few seconds and calls to listeners."""

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
INTERVAL = 5.0  # seconds between log lines
MIN_POLL_INTERVAL, MAX_POLL_INTERVAL = 0.5, 5.0  # seconds
MAX_POLLS = 40  # the interval grows to 1 / MAX_POLLS of the elapsed time, since a poll may start a process


class Listener(Protocol):
    """A function called with a label, the number of finished items, the total, and the seconds left, if known."""

    def __call__(self, label: str, done: int, total: int, /, *, seconds_left: float | None) -> None: ...


_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)
_level: ContextVar[int] = ContextVar("level", default=logging.INFO)  # level of log lines about counts


@contextmanager
def log_level(level: int) -> Iterator[None]:
    """Drop log messages below a level during the block, because the caller reports the same information."""
    previous = LOG.level
    LOG.setLevel(level)
    try:
        yield
    finally:
        LOG.setLevel(previous)


@contextmanager
def captured_log(level: int) -> Iterator[list[str]]:
    """Yield a list that collects the block's log messages at or above a level, instead of logging them."""
    messages: list[str] = []

    def capture(record: logging.LogRecord) -> bool:
        messages.append(record.getMessage())
        return False

    with log_level(level):
        LOG.addFilter(capture)
        try:
            yield messages
        finally:
            LOG.removeFilter(capture)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Call `listener`, and the listeners of enclosing blocks, for each step of the work in this block.

    Listeners are called from the thread of the block or from the thread of `polled`.
    """
    outer_listener = _listener.get()

    def call_both(label: str, done: int, total: int, /, *, seconds_left: float | None) -> None:
        for call in filter(None, (outer_listener, listener)):
            call(label, done, total, seconds_left=seconds_left)

    token = _listener.set(call_both)
    try:
        yield
    finally:
        _listener.reset(token)


@contextmanager
def logging_counts_as_debug() -> Iterator[None]:
    """Log the block's counts at debug level, because the caller shows them in another way."""
    token = _level.set(logging.DEBUG)
    try:
        yield
    finally:
        _level.reset(token)


class ItemCounter:
    """A counter of finished items; `label` describes them, such as 'photographs decoded'."""

    def __init__(self, label: str, total: int, is_uniform: bool = True) -> None:
        """is_uniform: whether all items take about the same time, so that the remaining time can be estimated."""
        self.label, self.total, self.done, self.is_uniform = label, total, 0, is_uniform
        self._start: tuple[float, int] | None = None  # time of the first report, and number of items done by then
        self._logged = time.monotonic()
        self.reach(0)

    @property
    def seconds_left(self) -> float | None:
        """The estimated time for the remaining items; None before the first item is done, or if not `is_uniform`."""
        if not self.is_uniform or self._start is None or self.done <= self._start[1]:
            return None
        start, start_count = self._start
        return (time.monotonic() - start) / (self.done - start_count) * (self.total - self.done)

    def reach(self, done: int) -> None:
        """Record the number of finished items, and report it unless the total is 0."""
        self.done = done
        if not self.total:
            return
        if self._start is None or self.done < self._start[1]:
            self._start = time.monotonic(), done
        seconds_left = self.seconds_left
        if listener := _listener.get():
            listener(self.label, done, self.total, seconds_left=seconds_left)
        if done and time.monotonic() - self._logged >= INTERVAL:
            self._logged = time.monotonic()
            remaining = f", {clock_text(seconds_left)} left" if seconds_left else ""
            LOG.log(_level.get(), "%s: %d of %d%s", self.label, done, self.total, remaining)


def counted(items: Iterable[Item], label: str, total: int) -> Iterator[Item]:
    """Yield the items and count them.  An item is done when the next one is requested."""
    counter = ItemCounter(label, total)
    for done, item in enumerate(items, 1):
        yield item
        counter.reach(done)


@contextmanager
def polled(counter: ItemCounter, poll: Callable[[], int]) -> Iterator[None]:
    """Report the progress of the block from a thread that calls `poll` for the number of finished items."""
    stop, context = threading.Event(), contextvars.copy_context()

    def watch() -> None:
        start = time.monotonic()
        while not stop.wait(min(max(MIN_POLL_INTERVAL, (time.monotonic() - start) / MAX_POLLS), MAX_POLL_INTERVAL)):
            done = poll()
            if done > counter.done:
                counter.reach(min(done, counter.total))

    thread = threading.Thread(target=context.run, args=(watch,), name="count", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def clock_text(seconds: float) -> str:
    """Format a duration as h:mm:ss or m:ss."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


class Stopped(Interrupted):
    """A stage stopped early because the run is stopping; it is repeated when the run resumes."""


@dataclass(frozen=True)
class Progress:
    """The state of training, for display."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, mean over recent training views, before 8-bit rounding
    gaussians: int | None  # None when training a field
    milliseconds: float  # per step
    seconds_left: float
    is_growth_known: bool = True  # False: densification will slow steps by an unknown amount
