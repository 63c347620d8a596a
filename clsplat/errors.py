"""Everything that can go wrong in a way the user can mend, each with its exit code.

A message is one line: what is wrong, where, what was expected, what to do.  The command line prints it without a
traceback (`--debug` shows one).
"""


class ClsplatError(Exception):
    """Base of all errors that are the user's to mend."""

    exit_code = 1


class ConfigError(ClsplatError):
    """A pipeline file, a setting or a command line that does not make sense."""

    exit_code = 2


class DataError(ClsplatError):
    """A dataset, image or model file that is missing, damaged or not supported."""

    exit_code = 3


class DeviceError(ClsplatError):
    """No such OpenCL device, or one whose runtime does not work."""

    exit_code = 4


class KernelError(DeviceError):
    """A kernel that does not build, or is called with the wrong arguments."""


class MemoryLimitError(ClsplatError):
    """The device cannot hold what was asked for."""

    exit_code = 5


class NumericError(ClsplatError):
    """Training produced values that are not finite."""

    exit_code = 6


class OutputError(ClsplatError):
    """A file that cannot be written or read back."""

    exit_code = 7


class Interrupted(ClsplatError):
    """The user stopped the run; what was done is saved."""

    exit_code = 130
