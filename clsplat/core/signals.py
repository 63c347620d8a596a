"""Handle Ctrl-C, SIGTERM, and SIGHUP, and keep stdout and stderr from failing."""

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

NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")  # SIGBREAK: Ctrl-Break on Windows, or a closed window
EXIT_DELAY_S = 60.0  # seconds between the end of stdin and a forced exit
IMPORT_SECONDS = 10.0  # longest wait for an import; the import of a plug-in may never end


class _Received:
    """The signals received since the outermost `stopping_on_signals` block began, and the number of nested blocks."""

    def __init__(self) -> None:
        self.blocks = 0
        self.number = 0  # number of the last signal; 0: none
        self.since = 0.0  # time of the first signal

    def record(self, number: int) -> None:
        self.since = self.since if self.number else time.monotonic()
        self.number = number


_received = _Received()


def exit_on_signals() -> None:
    """Make signals exit the process with a message and exit code 130, except in `stopping_on_signals` blocks.

    Call it at startup, before anything is written.  KeyboardInterrupt is not reliable: during the import of an
    extension module it aborts the process, and some libraries catch every exception.
    """
    for number in _handlers():
        signal.signal(number, _exit)


def _exit(number: int, frame: Any) -> NoReturn:
    with suppress(OSError):
        os.write(2, b"stopped\n")
    os._exit(130)


def stop_when_stdin_closes() -> None:
    """Stop the process, as SIGTERM would, when stdin closes because the parent process closed it or exited."""
    threading.Thread(target=_watch_stdin, name="input", daemon=True).start()


def _watch_stdin() -> None:
    """Wait for the end of stdin, and stop the process.

    This uses os.read, because a pending buffered read would abort the interpreter at exit.
    """
    with suppress(OSError):
        while os.read(0, 4096):
            pass
    _thread.interrupt_main(signal.SIGTERM)
    time.sleep(EXIT_DELAY_S)
    os._exit(130)


def _handlers() -> dict[int, Any]:
    """Return the handlers of all signals that are not ignored, by number.  Under nohup, SIGHUP stays ignored."""
    signal_numbers = [getattr(signal, name) for name in NAMES if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in signal_numbers}
    return {number: handler for number, handler in handlers.items() if handler not in (signal.SIG_IGN, None)}


@contextmanager
def stopping_on_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Call `stop` on Ctrl-C, SIGTERM, and SIGHUP during the block.  Outside the main thread, this has no effect."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handler(number: int, frame: Any) -> None:
        _received.record(number)
        stop()

    previous_handlers = _handlers()
    _received.blocks += 1
    try:
        for number in previous_handlers:
            signal.signal(number, handler)
        yield
    finally:
        for number, previous in previous_handlers.items():
            signal.signal(number, previous)
        _received.blocks -= 1
        if not _received.blocks:
            _received.number = 0


def stop_at_once() -> None:
    """Raise KeyboardInterrupt; during an import, which the exception would break, resend the signal a moment later."""
    wait_seconds = time.monotonic() - _received.since if _received.number else 0.0
    if wait_seconds < IMPORT_SECONDS and _is_importing():
        # `threading` would acquire a lock
        _thread.start_new_thread(_resend_signal, (_received.number or signal.SIGINT,))
    else:
        raise KeyboardInterrupt


def stop_if_signaled() -> None:
    """Raise KeyboardInterrupt if the outermost block received a signal, in case a library caught the exception."""
    if _received.number and threading.current_thread() is threading.main_thread():
        raise KeyboardInterrupt


def _is_importing() -> bool:
    frame = sys._getframe()
    while frame := frame.f_back:  # type: ignore[assignment]
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
    return False


def _resend_signal(number: int) -> None:
    time.sleep(0.02)
    _thread.interrupt_main(signal.Signals(number))


# stdout and stderr may be closed, full, or missing; writing to them never raises.


class Stream:
    """A wrapper of stdout or stderr (`name` in `sys`).  After a failure, it stores the error and drops all output."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.fault: OSError | ValueError | None = None
        self._original: Any = None

    @property
    def _raw(self) -> Any:
        stream = getattr(sys, self.name)
        stream = getattr(stream, "rich_proxied_file", stream)  # while rich draws a live display
        return self._original if stream is self else stream

    @property
    def rich_proxied_file(self) -> "Stream":
        """Make rich write to this wrapper, not to the stream behind it."""
        return self

    def __getattr__(self, name: str) -> Any:
        return getattr(self._raw, name)

    def write(self, text: str) -> int:
        """Write text; never raises, even if the stream is closed or broken."""
        self._call("write", text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream; like `write`, never raises."""
        self._call("flush")

    def _call(self, action: str, *arguments: str) -> None:
        stream = self._raw
        if self.fault is not None or stream is None:
            return
        try:
            getattr(stream, action)(*arguments)
        except UnicodeError:
            raise
        except RuntimeError:  # a signal handler printed during a write
            return
        except (OSError, ValueError) as error:  # ValueError: closed by this process
            self.fault = error
            _redirect_to_null(stream)

    def install(self) -> None:
        """Replace the stream in `sys` with this wrapper."""
        self.fault = None
        stream = self._raw
        if stream is None:  # closed before startup
            self.fault = OSError(errno.EBADF, os.strerror(errno.EBADF))
            stream = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")  # for file names that are not valid text
        self._original = stream
        setattr(sys, self.name, self)


STDOUT, STDERR = Stream("stdout"), Stream("stderr")


def install() -> None:
    """Keep printing from raising errors, and open closed standard descriptors on the null device.

    Otherwise, a file opened later would get the number of a closed descriptor, and printed text would go to the file.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # os.open returns the lowest free number
    STDOUT.install()
    STDERR.install()


def check_output() -> None:
    """Raise OutputError if stdout could not be written; a pipe closed by its reader is not an error."""
    STDOUT.flush()
    fault = STDOUT.fault
    if fault is None or _is_closed_by_reader(fault):
        return
    reason = getattr(fault, "strerror", None) or fault
    raise OutputError(f"stdout: cannot be written ({reason}); redirect it elsewhere, or free up space")


def _is_closed_by_reader(fault: OSError | ValueError) -> bool:
    is_windows_pipe = sys.platform == "win32" and getattr(fault, "errno", None) == errno.EINVAL
    return isinstance(fault, BrokenPipeError) or is_windows_pipe


def _redirect_to_null(stream: Any) -> None:
    """Redirect a stream to the null device, so that flushing its buffer at exit does not fail."""
    with suppress(OSError, ValueError, AttributeError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, stream.fileno())
        os.close(null)


def take_stdin() -> int:
    """Return a private descriptor of stdin, and replace stdin with an empty file for OpenCL runtimes.

    On Windows, a runtime that queries a pipe can block.
    """
    pipe, empty = os.dup(0), os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    return pipe


def take_stdout() -> TextIO:
    """Return a private stdout, and redirect what OpenCL runtimes print there to stderr."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return out
