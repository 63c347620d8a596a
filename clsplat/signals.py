"""What Ctrl-C, SIGTERM and SIGHUP do."""

import _thread
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # the last is of Windows: Ctrl-Break, or the window closes
GRACE = 60.0  # seconds for a process whose input has ended, before it is ended at once
IMPORT_SECONDS = 10.0  # that a signal waits for the end of an import: a plug-in's may have none


class _Received:
    """The signals of the outermost block, and how many blocks there are."""

    def __init__(self) -> None:
        self.blocks = 0
        self.number = 0  # of the last one; 0: there was none
        self.since = 0.0  # when the first one came

    def take(self, number: int) -> None:
        self.since = self.since if self.number else time.monotonic()
        self.number = number


_received = _Received()


def end_at_once_on_signals() -> None:
    """Let a signal end the process with its sentence and code, from here on where no block says what else to do.

    It is for the start, before anything is written: the import of an extension turns KeyboardInterrupt into an abort,
    and some libraries catch whatever is raised.
    """
    for number in _taken():
        signal.signal(number, _end_at_once)


def _end_at_once(number: int, frame: Any) -> NoReturn:
    with suppress(OSError):
        os.write(2, b"stopped\n")
    os._exit(130)


def stop_with_input() -> None:
    """Let the end of standard input stop the process as SIGTERM does: whoever has started it has ended, or says so."""
    threading.Thread(target=_watch_input, name="input", daemon=True).start()


def _watch_input() -> None:
    """Read with os.read: a buffered read that waits would abort the interpreter at its end."""
    with suppress(OSError):
        while os.read(0, 4096):
            pass
    _thread.interrupt_main(signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(130)


def _taken() -> dict[int, Any]:
    """Numbers and handlers of the signals; one that is ignored, as SIGHUP is under nohup, stays ignored."""
    numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in numbers}
    return {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C, SIGTERM and SIGHUP; outside the main thread nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handler(number: int, frame: Any) -> None:
        _received.take(number)
        stop()

    before = _taken()
    _received.blocks += 1
    try:
        for number in before:
            signal.signal(number, handler)
        yield
    finally:
        for number, other in before.items():
            signal.signal(number, other)
        _received.blocks -= 1
        if not _received.blocks:
            _received.number = 0


def stop_at_once() -> None:
    """Raise KeyboardInterrupt; in the middle of an import, which it would break, soon after its end."""
    waited = time.monotonic() - _received.since if _received.number else 0.0
    if waited < IMPORT_SECONDS and _is_importing():
        _thread.start_new_thread(_again, (_received.number or signal.SIGINT,))  # takes no lock, as `threading` does
    else:
        raise KeyboardInterrupt


def stop_if_signalled() -> None:
    """Raise KeyboardInterrupt where a signal came in the outermost block: a library may have caught the first one."""
    if _received.number and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt


def _is_importing() -> bool:
    frame = sys._getframe()
    while frame := frame.f_back:  # type: ignore[assignment]
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
    return False


def _again(number: int) -> None:
    time.sleep(0.02)
    _thread.interrupt_main(signal.Signals(number))
