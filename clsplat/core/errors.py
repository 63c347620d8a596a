"""Define the error classes and their exit codes.

A message is one line: the location, the fault, and the remedy.  The command line prints it without a traceback unless
`--debug` is given.
"""

import errno
import os
import reprlib
import shlex
import subprocess
import traceback
from collections.abc import Sequence
from itertools import islice

MESSAGE_LIMIT = 1000  # characters
QUOTE_LIMIT = 80  # characters of a value in a message
MAX_NAMES = 8  # names of a list in a message
PLUGIN_MARK = "__clsplat_plugin__"  # module variable that marks plug-in code


class ClsplatError(Exception):
    """Base of all errors."""

    exit_code = 1


class InternalError(ClsplatError):
    """A bug in clsplat that should be reported; `--debug` shows its traceback."""


class ConfigError(ClsplatError):
    """A pipeline file, setting, or command line is invalid."""

    exit_code = 2


class OverrideError(ConfigError):
    """A value given by `--set` is not valid in the pipeline; `reason` says why."""

    def __init__(self, override: str, reason: str) -> None:
        self.reason = shorten(" ".join(reason.split()), 500)
        super().__init__(f"--set {shorten(' '.join(override.split()))}: {self.reason}")


class PluginError(ConfigError):
    """The code of a plug-in raised an exception."""


class DataError(ClsplatError):
    """A dataset, image, or model file is missing, damaged, or not supported."""

    exit_code = 3


class PoseError(DataError, ValueError):
    """The pose of a view has the wrong shape, is not finite, or has no valid rotation."""


class DeviceError(ClsplatError):
    """An OpenCL device does not exist, or its runtime does not work."""

    exit_code = 4


class KernelError(DeviceError):
    """A kernel does not build or was called with the wrong arguments."""


class MemoryLimitError(ClsplatError):
    """The device or the host has too little memory."""

    exit_code = 5


class NumericError(ClsplatError):
    """Values in training or in a render are not finite, or no Gaussians remain."""

    exit_code = 6


class NotFiniteError(NumericError):
    """The training state is not finite.  It was saved separately as failed_N.npz."""


class EmptyRegionError(NumericError):
    """A region of space contains no Gaussians."""


class OutputError(ClsplatError):
    """A file cannot be written or read back, or a folder is in use."""

    exit_code = 7


class Interrupted(ClsplatError):
    """Ctrl-C, SIGTERM, or SIGHUP stopped the command; the state of a run is saved."""

    exit_code = 130


def as_clsplat_error(error: BaseException) -> ClsplatError:
    """Convert any exception to a ClsplatError; a ClsplatError is returned unchanged."""
    if isinstance(error, RuntimeError) and isinstance(error.__cause__, StopIteration):  # raised inside a generator
        error = error.__cause__
    if isinstance(error, ClsplatError):
        return error
    if isinstance(error, KeyboardInterrupt):
        return Interrupted("stopped at once; to continue, repeat the command, with --resume if a checkpoint was saved")
    if isinstance(error, MemoryError):
        return MemoryLimitError("out of memory; use fewer Gaussians, or fewer or smaller images (scene.downscale)")
    if isinstance(error, ImportError) and "failed to map segment" in str(error):
        remedy = "free up memory, raise `ulimit -v`, or use a file system that is mounted without `noexec`"
        return MemoryLimitError(f"{one_line(error)}; {remedy}")
    # this is the name of an input, because `write_error` has already converted errors about outputs
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        return DataError(f"{error.filename}: cannot be read ({error.strerror}); expected the path of a file or folder")
    if isinstance(error, OSError) and error.strerror:
        name = error.filename or "the output"
        return OutputError(f"{name}: {error.strerror}; check the file, its folder, and the free space")
    message = f"{type(error).__name__}: {one_line(error)}".removesuffix(": ")
    if location := _plugin_location(error):
        return PluginError(f"{location}: {message}")
    return InternalError(f"internal error (a bug): {message}; run with --debug for the traceback, and report it")


def _plugin_location(error: BaseException) -> str | None:
    """Return the innermost file and line of plug-in code in the traceback, or None."""
    frames = reversed(list(traceback.walk_tb(error.__traceback__)))
    return next((f"{f.f_code.co_filename}:{line}" for f, line in frames if PLUGIN_MARK in f.f_globals), None)


def one_line(error: BaseException | str) -> str:
    """Return a message as one line of limited length, with control characters escaped."""
    text = shorten(" ".join(str(error).split()), MESSAGE_LIMIT)
    return shorten("".join(c if c.isprintable() else ascii(c)[1:-1] for c in text), MESSAGE_LIMIT)


def first_few(names: Sequence[str]) -> str:
    """Join the first MAX_NAMES names for a message, and append the number of the remaining names."""
    more = f", and {len(names) - MAX_NAMES} more" if len(names) > MAX_NAMES else ""
    return ", ".join(names[:MAX_NAMES]) + more


def pluralize(count: int, word: str) -> str:
    """Format a count with its noun: `1 view`, `2,000 views`."""
    return f"{count:,} {word}{'s' if count != 1 else ''}"


def size_text(gaussians: int | None, parameters: int | None, sky: int = 0) -> str:
    """Format the size of a model: its numbers of Gaussians and `sky` Gaussians, or a field's number of parameters."""
    text = f"{parameters or 0:,} parameters" if gaussians is None else f"{gaussians:,} Gaussians"
    return f"{text} and {sky:,} of the sky" if sky else text


def shell_quote(path: object) -> str:
    """Quote a path for a shell command in a message."""
    return subprocess.list2cmdline([str(path)]) if os.name == "nt" else shlex.quote(str(path))


def shorten(text: str, limit: int = QUOTE_LIMIT) -> str:
    """Return the text; if it is longer than `limit` characters, replace its middle with an ellipsis."""
    size = limit - 3
    return text if len(text) <= limit else f"{text[: size - size // 2]} … {text[-(size // 2) :]}"


def quote(value: object) -> str:
    """Return the repr of an input value for a message, as one line of at most QUOTE_LIMIT characters."""
    return shorten(" ".join(_QUOTES.repr(value).split()))


class _Quotes(reprlib.Repr):
    """A repr whose cost does not grow with the size of the value."""

    def __init__(self) -> None:
        super().__init__()
        self.fillvalue = "…"
        self.maxlist = self.maxtuple = self.maxdict = 8
        self.maxlevel = 4
        self.maxstring = self.maxother = self.maxlong = 2 * QUOTE_LIMIT

    def repr_int(self, x: int, level: int) -> str:
        return f"a number of {x.bit_length()} bits" if x.bit_length() > 256 else repr(x)

    def repr_dict(self, x: dict[object, object], level: int) -> str:
        """Show the first keys in insertion order; `reprlib` would sort all of them."""
        if level <= 0:
            return f"{{{self.fillvalue}}}"
        items = [f"{self.repr1(key, level - 1)}: {self.repr1(x[key], level - 1)}" for key in islice(x, self.maxdict)]
        return f"{{{', '.join([*items, *([self.fillvalue] if len(x) > self.maxdict else [])])}}}"


_QUOTES = _Quotes()
