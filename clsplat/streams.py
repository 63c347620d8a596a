"""stdout and stderr, which may be closed, full or gone: what is written there ends nothing."""

import errno
import os
import sys
from contextlib import suppress
from typing import Any, TextIO

from clsplat.errors import OutputError


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


def only_reader_of_stdin() -> int:
    """Return a number for stdin; runtimes get an empty one: on Windows asking about a pipe may wait for readers."""
    pipe, empty = os.dup(0), os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    return pipe


def only_writer_of_stdout() -> TextIO:
    """Return stdout, and send what runtimes print there to stderr from here on."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return out
