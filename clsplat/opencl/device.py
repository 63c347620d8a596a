"""An open OpenCL device: its context, its queue, its memory and its programs.

This package is the only importer of pyopencl.
"""

import logging
import math
import threading
import warnings
import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.errors import ConfigError, KernelError, MemoryLimitError
from clsplat.opencl import runtimes
from clsplat.opencl.discovery import DeviceInfo, Schedule, choose, platforms, resolve_schedule, tuning_of
from clsplat.opencl.kernel_caches import remove_cut_kernels
from clsplat.opencl.refusals import refusals
from clsplat.opencl.timings import Timings

runtimes.prepare()
import pyopencl as cl  # noqa: E402

if TYPE_CHECKING:
    from clsplat.opencl.program import Program

warnings.filterwarnings("ignore", category=cl.CompilerWarning)  # some runtimes warn at every build


LOG = logging.getLogger("clsplat")


class Buffer(cl.Buffer):
    """Device memory with weak references, which pyopencl's class does not support."""


class Array:
    """A typed array in device memory, without arithmetic."""

    __slots__ = ("buffer", "device", "dtype", "shape")

    def __init__(self, device: "Device", buffer: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.device, self.buffer, self.shape, self.dtype = device, buffer, shape, dtype

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    def get(self) -> NDArray[Any]:
        """Copy to the host; waits for the device.  Raises MemoryLimitError, DeviceError."""
        host = np.empty(self.shape, self.dtype)
        if host.size:
            with self.device.refusals("a copy to the host"):
                cl.enqueue_copy(self.device.queue, host, self.buffer)
        return host

    def get_later(self) -> Callable[[], NDArray[Any]]:
        """Begin a copy to the host of what the array holds after all that is enqueued so far.

        The result waits for that alone, not for what is enqueued later.  Raises MemoryLimitError, DeviceError.
        """
        host = np.empty(self.shape, self.dtype)
        with self.device.refusals("a copy to the host"):
            copied = cl.enqueue_copy(self.device.queue, host, self.buffer, is_blocking=False)

        def waited() -> NDArray[Any]:
            with self.device.refusals("a copy to the host"):
                copied.wait()
            return host

        return waited

    def get_item(self, index: int) -> Any:
        """Copy one value of a one-dimensional array to the host.  As `get`."""
        host = np.empty(1, self.dtype)
        with self.device.refusals("a copy to the host"):
            cl.enqueue_copy(self.device.queue, host, self.buffer, src_offset=index * self.dtype.itemsize)
        return host[0]

    def set(self, values: NDArray[Any]) -> None:
        """Copy from the host; the shapes must agree.  Raises MemoryLimitError, DeviceError."""
        host = np.ascontiguousarray(values, self.dtype)
        if host.shape != self.shape:
            raise ValueError(f"cannot copy {host.shape} into {self.shape}")
        if host.size:
            with self.device.refusals("a copy to the device"):
                cl.enqueue_copy(self.device.queue, self.buffer, host)

    def fill(self, value: float) -> None:
        """Set every value of an array of floats or 32-bit integers."""
        word = int(np.array(value, self.dtype).view(np.uint32))
        words = Array(self.device, self.buffer, self.shape, np.dtype(np.uint32))
        lines = -(-self.nbytes // 64)  # a number of words would not fit in 32 bits from 16 GiB on
        self.device.program("fill.cl").fill_words(items=lines, values=words, word=word, lines=lines)


class Device:
    """An open device: one context, one order of commands, programs built once.

    Raises MemoryLimitError or DeviceError where the runtime refuses to open it, KernelError where nothing can blend.
    """

    def __init__(self, info: DeviceInfo, schedule: Schedule = "auto") -> None:
        platform, number = info.place
        self.info = info
        remove_cut_kernels()
        timed = cl.command_queue_properties.PROFILING_ENABLE
        with self.refusals("opening it"):
            self.context = context_of(platforms()[platform].get_devices()[number])
            self._queues = {False: cl.CommandQueue(self.context), True: cl.CommandQueue(self.context, properties=timed)}
        self._sampling = False  # whether the timed queue is in use: it costs the host
        self.schedule = resolve_schedule(info, schedule)
        self.tuning = tuning_of(info, self.schedule)
        self.timings = Timings(info.name)
        self.allocated = 0  # bytes of all buffers that are alive
        self.peak = 0  # largest value of `allocated`
        self.lock = threading.Lock()  # of what threads share: the programs, and the arguments of their kernels
        self._programs: dict[tuple[Any, ...], Program] = {}
        if self.schedule == "simt":
            self._fit_groups()

    def _fit_groups(self) -> None:
        """Take tiles of 8 x 8 px where the compiler allows blending no group of 16 x 16 items."""
        try:
            self.program("blend_simt.cl")
        except KernelError as error:
            if self.tuning["TILE"] == 8:
                raise
            LOG.info("tiles of 8 x 8 px instead of 16 x 16: %s", error)
            self.tuning["TILE"] = 8
            self.program("blend_simt.cl")

    @property
    def text(self) -> str:
        return f"{self.info.text}, {self.schedule} schedule"

    @property
    def queue(self) -> Any:
        """The queue of commands, the timed one while `timings` samples; at a change the device waits, not the host."""
        sampling = self.timings.sampling
        if sampling != self._sampling:
            before = cl.enqueue_marker(self._queues[self._sampling])
            self._queues[self._sampling].flush()
            cl.enqueue_barrier(self._queues[sampling], wait_for=[before])
            self._sampling = sampling
        return self._queues[sampling]

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> Array:
        """Allocate an array with undefined values.  Raises MemoryLimitError with the sizes."""
        shape = (shape,) if isinstance(shape, int) else shape
        kind = np.dtype(dtype)
        size = _whole_lines(math.prod(shape) * kind.itemsize)
        if size > self.info.allocation:
            raise MemoryLimitError(
                f"one buffer of {size / 2**20:.0f} MiB is more than {self.info.name} allows "
                f"({self.info.allocation / 2**20:.0f} MiB); use fewer Gaussians or smaller images"
            )
        try:
            buffer = Buffer(self.context, cl.mem_flags.READ_WRITE, size)
        except cl.Error as error:
            raise MemoryLimitError(
                f"{self.info.name} could not allocate {size / 2**20:.0f} MiB more ({error}); "
                "use fewer Gaussians or smaller images"
            ) from error
        self.allocated += size
        self.peak = max(self.peak, self.allocated)
        weakref.finalize(buffer, self._released, size)
        return Array(self, buffer, shape, kind)

    def _released(self, size: int) -> None:
        self.allocated -= size

    def zeros(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> Array:
        """Allocate an array of zeros.  Raises MemoryLimitError."""
        array = self.empty(shape, dtype)
        array.fill(0)
        return array

    def upload(self, values: NDArray[Any]) -> Array:
        """Copy an array from the host.  Raises MemoryLimitError."""
        array = self.empty(values.shape, values.dtype)
        array.set(values)
        return array

    def program(self, file: str | Path, **defines: int | str) -> "Program":
        """Build `cl_kernels/<file>`, or a file by its absolute path, with this device's tuning and `defines`, once.

        Raises KernelError when it does not build or is missing.
        """
        from clsplat.opencl.program import Program

        key = (str(file), *defines.items(), *self.tuning.items())
        with self.lock:
            if key not in self._programs:
                self._programs[key] = Program(self, file, {**self.tuning, **defines})
            return self._programs[key]

    def finish(self) -> None:
        """Wait for all enqueued work.  Raises MemoryLimitError, DeviceError."""
        with self.refusals("work in progress"):
            self.queue.finish()

    def refusals(self, what: str) -> AbstractContextManager[None]:
        """Convert what the runtime refuses in a block, in which `what` is done."""
        return refusals(what, self.info.name)


def context_of(device: Any) -> Any:
    """Return a new context of a device of the runtime."""
    return cl.Context([device])


def open_device(device: str | Device | None = None, schedule: Schedule = "auto") -> Device:
    """Return a device that is open, or open one by a part of its name; None: as `choose` does.

    Raises DeviceError when there is none, ConfigError for an open device of another schedule.
    """
    if device is None or isinstance(device, str):
        return Device(choose(device), schedule)
    if not isinstance(device, Device):
        raise ConfigError(f"device: is a {type(device).__name__}; expected a part of a device's name, or a Device")
    if schedule != "auto" and resolve_schedule(device.info, schedule) != device.schedule:
        raise ConfigError(f"device: {device.text}; expected the {schedule} schedule, as the settings say: open it so")
    return device


def _whole_lines(size: int) -> int:
    """Bytes rounded up to 64, at least 64: vectors may read past the last value; no buffer may be empty."""
    return max(64, -(-size // 64) * 64)
