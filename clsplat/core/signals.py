"""What Ctrl-C, SIGTERM and SIGHUP do."""

import _thread
import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn, TextIO

from clsplat.core.errors import OutputError

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


def exit_on_signals() -> None:
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


def stop_if_signaled() -> None:
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


# stdout and stderr, which may be closed, full or gone: what is written there ends nothing.


class Stream:
    """stdout or stderr, by its name in `sys`; after the first failure it drops what it is given, and knows why."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.fault: OSError | ValueError | None = None
        self._replaced: Any = None

    @property
    def _raw(self) -> Any:
        stream = getattr(sys, self.name)
        stream = getattr(stream, "rich_proxied_file", stream)  # while a live line is shown
        return self._replaced if stream is self else stream

    @property
    def rich_proxied_file(self) -> "Stream":
        """What rich writes to: this, not the stream behind it."""
        return self

    def __getattr__(self, name: str) -> Any:
        return getattr(self._raw, name)

    def write(self, text: str) -> int:
        """Write text; never raises for the state of the stream."""
        self._do("write", text)
        return len(text)

    def flush(self) -> None:
        """Write what is held back; never raises for the state of the stream."""
        self._do("flush")

    def _do(self, action: str, *arguments: str) -> None:
        stream = self._raw
        if self.fault is not None or stream is None:
            return
        try:
            getattr(stream, action)(*arguments)
        except UnicodeError:
            raise
        except RuntimeError:  # the handler of a signal prints while the stream is being written
            return
        except (OSError, ValueError) as error:  # ValueError: closed by this process
            self.fault = error
            _silence(stream)

    def install(self) -> None:
        """Put this in the place of the stream in `sys`, for everything that prints."""
        self.fault = None
        stream = self._raw
        if stream is None:  # closed before the start
            self.fault = OSError(errno.EBADF, os.strerror(errno.EBADF))
            stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # of file names that are not text
        self._replaced = stream
        setattr(sys, self.name, self)


STDOUT, STDERR = Stream("stdout"), Stream("stderr")


def install() -> None:
    """Let nothing that prints fail; descriptors closed before the start lead nowhere, not into the next open file."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it takes the lowest free number
    STDOUT.install()
    STDERR.install()


def check_output() -> None:
    """Raise OutputError where stdout could not be written; a reader that closed the pipe has what it wanted."""
    STDOUT.flush()
    fault = STDOUT.fault
    if fault is None or _closed_by_reader(fault):
        return
    reason = getattr(fault, "strerror", None) or fault
    raise OutputError(f"stdout: cannot be written ({reason}); let it lead elsewhere, or free its space")


def _closed_by_reader(fault: OSError | ValueError) -> bool:
    windows = sys.platform == "win32" and getattr(fault, "errno", None) == errno.EINVAL
    return isinstance(fault, BrokenPipeError) or windows


def _silence(stream: Any) -> None:
    """Let a stream lead nowhere: what it still holds is flushed at the end, which must not fail."""
    with suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def take_stdin() -> int:
    """Return a number for stdin; runtimes get an empty one: on Windows asking about a pipe may wait for readers."""
    pipe, empty = os.dup(0), os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    return pipe


def take_stdout() -> TextIO:
    """Return stdout, and send what runtimes print there to stderr from here on."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return out
