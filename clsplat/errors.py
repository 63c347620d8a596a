"""Everything that can go wrong, each with its exit code.

A message is one line: what is wrong, where, what was expected, what to do.  The command line prints it without a
traceback (`--debug` shows one).
"""

MESSAGE_LIMIT = 1000  # characters


class ClsplatError(Exception):
    """Base of all errors."""

    exit_code = 1


class InternalError(ClsplatError):
    """A defect of the program."""


class ConfigError(ClsplatError):
    """A pipeline file, a setting or a command line that does not make sense."""

    exit_code = 2


class OverrideError(ConfigError):
    """A value of `--set` that does not fit the pipeline; `reason` is what is wrong with it."""

    def __init__(self, override: str, reason: str) -> None:
        self.reason = shortened(reason, 500)
        super().__init__(f"--set {shortened(override, 80)}: {self.reason}")


class DataError(ClsplatError):
    """A dataset, image or model file that is missing, damaged or not supported."""

    exit_code = 3


class DeviceError(ClsplatError):
    """No such OpenCL device, or one whose runtime does not work."""

    exit_code = 4


class KernelError(DeviceError):
    """A kernel that does not build, or is called with the wrong arguments."""


class MemoryLimitError(ClsplatError):
    """The device or the host cannot hold what was asked for."""

    exit_code = 5


class NumericError(ClsplatError):
    """Training produced values that are not finite."""

    exit_code = 6


class OutputError(ClsplatError):
    """A file that cannot be written or read back."""

    exit_code = 7


class Interrupted(ClsplatError):
    """The user stopped the run."""

    exit_code = 130


def as_clsplat_error(error: BaseException) -> ClsplatError:
    """Return the error that a user sees in place of any exception; a ClsplatError stays what it is."""
    if isinstance(error, ClsplatError):
        return error
    if isinstance(error, KeyboardInterrupt):
        return Interrupted("stopped at once; --resume goes on from the last checkpoint")
    if isinstance(error, MemoryError):
        return MemoryLimitError("out of memory; use smaller images (scene.downscale) or fewer of them")
    if isinstance(error, OSError) and error.strerror:
        place = error.filename or "the output"
        return OutputError(f"{place}: {error.strerror}; check the file, its folder and their space")
    what = f"{type(error).__name__}: {one_line(error)}".removesuffix(": ")
    return InternalError(f"internal error (a defect): {what}; run with --debug for the traceback, and report it")


def one_line(error: BaseException) -> str:
    """The message of an error, in one line of limited length."""
    return shortened(" ".join(str(error).split()), MESSAGE_LIMIT)


def shortened(text: str, limit: int = 200) -> str:
    """The text, cut in the middle where it is longer than `limit` characters."""
    half = limit // 2
    return text if len(text) <= limit else f"{text[:half]} … {text[-half:]}"
