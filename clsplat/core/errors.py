"""All errors, each with its exit code.

A message is one line: the fault, its place, what was expected, the remedy.  The command line prints it without a
traceback (`--debug` shows one).
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
NAMES_SHOWN = 8  # of a list, in a message
PLUGIN_MARK = "__clsplat_plugin__"  # the name of the plug-in, a variable of its module


class ClsplatError(Exception):
    """Base of all errors."""

    exit_code = 1


class InternalError(ClsplatError):
    """A defect of clsplat, to be reported; `--debug` shows its traceback."""


class ConfigError(ClsplatError):
    """A pipeline file, a setting or a command line is invalid."""

    exit_code = 2


class OverrideError(ConfigError):
    """A value of `--set` does not fit the pipeline; `reason` is the fault."""

    def __init__(self, override: str, reason: str) -> None:
        self.reason = shorten(" ".join(reason.split()), 500)
        super().__init__(f"--set {shorten(' '.join(override.split()))}: {self.reason}")


class PluginError(ConfigError):
    """The code of a plug-in raised an exception."""


class DataError(ClsplatError):
    """A dataset, image or model file is missing, damaged or not supported."""

    exit_code = 3


class PoseError(DataError, ValueError):
    """The pose of a view has another shape, is not finite or has no rotation."""


class DeviceError(ClsplatError):
    """An OpenCL device does not exist, or its runtime does not work."""

    exit_code = 4


class KernelError(DeviceError):
    """A kernel does not build, or has wrong arguments."""


class MemoryLimitError(ClsplatError):
    """The memory of the device or the host is too small."""

    exit_code = 5


class NumericError(ClsplatError):
    """Values of training or of a picture are not finite, or no Gaussians are left."""

    exit_code = 6


class NotFiniteError(NumericError):
    """The state of a training is not finite; it was set aside, as failed_N.npz."""


class EmptyRegionError(NumericError):
    """No Gaussian lies in a part of space."""


class OutputError(ClsplatError):
    """A file cannot be written or read back, or a folder is in use."""

    exit_code = 7


class Interrupted(ClsplatError):
    """Ctrl-C, SIGTERM or SIGHUP stopped the command; the state of a run is saved."""

    exit_code = 130


def as_clsplat_error(error: BaseException) -> ClsplatError:
    """Return the ClsplatError for any exception; a ClsplatError stays unchanged."""
    if isinstance(error, RuntimeError) and isinstance(error.__cause__, StopIteration):  # what a generator makes of it
        error = error.__cause__
    if isinstance(error, ClsplatError):
        return error
    if isinstance(error, KeyboardInterrupt):
        return Interrupted("stopped at once; to go on, run it again, with --resume where a checkpoint was saved")
    if isinstance(error, MemoryError):
        return MemoryLimitError("out of memory; use fewer Gaussians, smaller images (scene.downscale) or fewer of them")
    if isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:  # that of an output is an OutputError already
        return DataError(f"{error.filename}: cannot be read ({error.strerror}); expected the path of a file or folder")
    if isinstance(error, OSError) and error.strerror:
        place = error.filename or "the output"
        return OutputError(f"{place}: {error.strerror}; check the file, its folder and their space")
    what = f"{type(error).__name__}: {one_line(error)}".removesuffix(": ")
    if place := _plugin_place(error):
        return PluginError(f"{place}: {what}")
    return InternalError(f"internal error (a defect): {what}; run with --debug for the traceback, and report it")


def _plugin_place(error: BaseException) -> str | None:
    """The innermost file and line of a plug-in that an exception passed, or None."""
    frames = reversed(list(traceback.walk_tb(error.__traceback__)))
    return next((f"{f.f_code.co_filename}:{line}" for f, line in frames if PLUGIN_MARK in f.f_globals), None)


def one_line(error: BaseException | str) -> str:
    """Return a message as one line of limited length, without characters that a terminal obeys."""
    text = shorten(" ".join(str(error).split()), MESSAGE_LIMIT)
    return shorten("".join(c if c.isprintable() else ascii(c)[1:-1] for c in text), MESSAGE_LIMIT)


def first_few(names: Sequence[str]) -> str:
    """Return the first names of a list, and how many more there are, for a message."""
    more = f", and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    return ", ".join(names[:NAMES_SHOWN]) + more


def pluralize(count: int, word: str) -> str:
    """Return a number with its noun: `1 view`, `2,000 views`."""
    return f"{count:,} {word}{'s' if count != 1 else ''}"


def size_text(gaussians: int | None, parameters: int | None) -> str:
    """Return how large what was trained is, in words."""
    return f"{parameters or 0:,} parameters" if gaussians is None else f"{gaussians:,} Gaussians"


def shell_quote(path: object) -> str:
    """Return a path as a shell reads it, for a command in a message."""
    return subprocess.list2cmdline([str(path)]) if os.name == "nt" else shlex.quote(str(path))


def shorten(text: str, limit: int = QUOTE_LIMIT) -> str:
    """Return the text, cut in the middle where it is longer than `limit` characters."""
    kept = limit - 3
    return text if len(text) <= limit else f"{text[: kept - kept // 2]} … {text[-(kept // 2) :]}"


def quote(value: object) -> str:
    """Return a value of the input as a message shows it, in one line of QUOTE_LIMIT characters."""
    return shorten(" ".join(_QUOTES.repr(value).split()))


class _Quotes(reprlib.Repr):
    """The notation of Python, which takes no longer for a large value."""

    def __init__(self) -> None:
        super().__init__()
        self.fillvalue = "…"
        self.maxlist = self.maxtuple = self.maxdict = 8
        self.maxlevel = 4
        self.maxstring = self.maxother = self.maxlong = 2 * QUOTE_LIMIT

    def repr_int(self, x: int, level: int) -> str:
        return f"a number of {x.bit_length()} bits" if x.bit_length() > 256 else repr(x)

    def repr_dict(self, x: dict[object, object], level: int) -> str:
        """The first keys, in their own order."""
        if level <= 0:
            return f"{{{self.fillvalue}}}"
        shown = [f"{self.repr1(key, level - 1)}: {self.repr1(x[key], level - 1)}" for key in islice(x, self.maxdict)]
        return f"{{{', '.join([*shown, *([self.fillvalue] if len(x) > self.maxdict else [])])}}}"


_QUOTES = _Quotes()
