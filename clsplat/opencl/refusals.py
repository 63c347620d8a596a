"""What a runtime refuses, as the errors of this program."""

from collections.abc import Iterator
from contextlib import contextmanager

import pyopencl as cl

from clsplat.errors import DeviceError, MemoryLimitError


@contextmanager
def refusals(what: str, device_name: str) -> Iterator[None]:
    """Raise MemoryLimitError or DeviceError, with `what` was to be done, where a runtime refuses a call in the block.

    Some runtimes take device memory when it is first used, and refuse it at a launch or a copy.
    """
    try:
        yield
    except cl.MemoryError as error:
        raise MemoryLimitError(
            f"{what}: {device_name} is out of memory ({error}); use fewer Gaussians or smaller images"
        ) from error
    except cl.Error as error:
        raise DeviceError(f"{what} failed on {device_name}: {error}") from error
