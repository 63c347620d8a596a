"""The device of a notebook."""

import threading
from functools import cache
from types import TracebackType

from clsplat.conformance.quick import open_correct
from clsplat.opencl import device as opencl
from clsplat.opencl.discovery import Schedule, choose
from clsplat.render.tiles import Sort


class Device(opencl.Device):
    """An open OpenCL device; a `with` block waits at its end for all its work.

    Memory is released with the arrays, and the device with the last object that uses it.

    `name` is a part of a runtime's or device's name, as `clsplat devices` prints them; without it CLSPLAT_DEVICE, else
    the first GPU that works, else the first CPU.  Raises DeviceError when there is none.
    """

    def __init__(self, name: str | None = None, schedule: Schedule = "auto") -> None:
        super().__init__(choose(name), schedule)

    def __enter__(self) -> "Device":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.finish()

    def __repr__(self) -> str:
        return f"Device({self.text!r})"


def proved(device: str | opencl.Device | None, schedule: Schedule = "auto", sort: Sort = "auto") -> opencl.Device:
    """Return an open device, one of a name, or `default_device`, on which pictures and models may be made.

    It was compared with the reference once, as for a run.  Raises DeviceError when it computes wrongly.
    """
    return open_correct(default_device(schedule) if device is None else device, schedule, sort)


_OPENING = threading.Lock()


def default_device(schedule: Schedule = "auto") -> Device:
    """Return the device that is taken where none is given; opened on first use."""
    with _OPENING:  # two threads get the same one
        return _opened(schedule)


@cache
def _opened(schedule: Schedule) -> Device:
    return Device(schedule=schedule)
