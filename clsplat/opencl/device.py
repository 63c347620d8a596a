"""One OpenCL device: how it is found and chosen, its memory and its limits.

This package is the only importer of pyopencl.  The device is chosen once and passed explicitly; nothing falls back
to another one in silence.
"""

import logging
import math
import os
import re
import warnings
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.errors import ConfigError, DeviceError, MemoryLimitError
from clsplat.opencl import runtimes
from clsplat.opencl.timings import Timings

runtimes.add_intel_runtime()
import pyopencl as cl  # noqa: E402

if TYPE_CHECKING:
    from clsplat.opencl.program import Program

DEVICE_VARIABLE = "CLSPLAT_DEVICE"
LOG = logging.getLogger("clsplat")
warnings.filterwarnings("ignore", category=cl.CompilerWarning)  # some runtimes always have something to say
Schedule = Literal["auto", "wide", "simt"]


@dataclass(frozen=True)
class DeviceInfo:
    """What the runtime says about a device, and how to get at it."""

    name: str
    platform: str  # name and version of the runtime
    kind: Literal["GPU", "CPU", "other"]
    driver: str
    units: int  # compute units
    memory: int  # bytes
    allocation: int  # bytes, largest single buffer
    local_memory: int  # bytes per work-group
    group: int  # items, largest work-group
    float_width: int  # lanes of the vector unit
    place: tuple[int, int]  # platform and device number

    @property
    def text(self) -> str:
        return f"{self.name} ({self.kind}) on {self.platform}"

    def fault(self) -> str | None:
        """Return None if the device runs a test kernel, else a sentence on what is wrong."""
        return runtimes.fault_of(f"{self.platform}|{self.name}|{self.driver}|{cl.VERSION_TEXT}", *self.place)

    def matches(self, words: str) -> bool:
        return words.lower() in f"{self.platform} {self.name} {self.kind}".lower()


def list_devices() -> list[DeviceInfo]:
    """Return every device of every runtime, in the loader's order; runtimes without devices are normal."""
    found = []
    for p, platform in enumerate(_platforms()):
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue
        for d, device in enumerate(devices):
            found.append(_info(platform, device, (p, d)))
    return found


def _platforms() -> list[Any]:
    try:
        return list(cl.get_platforms())
    except cl.Error:  # the loader found no runtime at all
        return []


def _info(platform: Any, device: Any, place: tuple[int, int]) -> DeviceInfo:
    kinds = cl.device_type
    return DeviceInfo(
        name=device.name.strip(),
        platform=f"{platform.name.strip()}, {_short(platform.version)}",
        kind="GPU" if device.type & kinds.GPU else "CPU" if device.type & kinds.CPU else "other",
        driver=device.driver_version.strip(),
        units=device.max_compute_units,
        memory=device.global_mem_size,
        allocation=device.max_mem_alloc_size,
        local_memory=device.local_mem_size,
        group=device.max_work_group_size,
        float_width=device.native_vector_width_float,
        place=place,
    )


def _short(version: str) -> str:
    """'OpenCL 3.0 PoCL 3.1+debian  Linux, None+Asserts, ...' -> 'OpenCL 3.0 PoCL 3.1+debian'."""
    return " ".join(version.split(",")[0].split()[:4])


def choose(words: str | None = None) -> DeviceInfo:
    """Pick a device; runtimes that are passed over because they do not work are named in the log.

    `words` is a part of a runtime's or device's name, with `:n` for the n-th that matches; without it the variable
    CLSPLAT_DEVICE, else the first GPU that works, else the first CPU.  Raises DeviceError naming what exists.
    """
    words = words or os.environ.get(DEVICE_VARIABLE)
    devices = list_devices()
    if not devices:
        raise DeviceError(
            "no OpenCL device was found; install a runtime: pip install 'clsplat[pocl]', pip install 'clsplat[intel]', "
            "apt install pocl-opencl-icd, or your GPU's driver"
        )
    if words:
        return _named(words, devices)
    faults = []
    for info in sorted(devices, key=lambda i: i.kind != "GPU"):
        fault = info.fault()
        if fault is None:
            return info
        faults.append(f"{info.text} does not work: {fault}")
        LOG.warning(faults[-1])
    raise DeviceError("; ".join(faults))


def _named(words: str, devices: list[DeviceInfo]) -> DeviceInfo:
    numbered = re.fullmatch(r"(.*):([0-9]{1,4})", words, re.DOTALL)
    name, number = numbered.groups() if numbered else (words, "0")
    matching = [info for info in devices if info.matches(name)]
    if int(number) >= len(matching):
        raise DeviceError(f"no device matches '{words}'; there are: {'; '.join(i.text for i in devices)}")
    info = matching[int(number)]
    fault = info.fault()
    if fault is not None:
        raise DeviceError(f"{info.text} does not work: {fault}")
    return info


class Buffer(cl.Buffer):
    """Device memory whose end can be noticed, which pyopencl's own class does not allow."""


class Array:
    """A typed piece of device memory; it has no arithmetic."""

    __slots__ = ("buffer", "device", "dtype", "shape")

    def __init__(self, device: "Device", buffer: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.device, self.buffer, self.shape, self.dtype = device, buffer, shape, dtype

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    def get(self) -> NDArray[Any]:
        """Copy to the host; waits for the device."""
        host = np.empty(self.shape, self.dtype)
        if host.size:
            cl.enqueue_copy(self.device.queue, host, self.buffer)
        return host

    def get_item(self, index: int) -> Any:
        """Copy one value of a one-dimensional array to the host; waits for the device."""
        host = np.empty(1, self.dtype)
        cl.enqueue_copy(self.device.queue, host, self.buffer, src_offset=index * self.dtype.itemsize)
        return host[0]

    def set(self, values: NDArray[Any]) -> None:
        """Copy from the host; the shapes must agree."""
        host = np.ascontiguousarray(values, self.dtype)
        if host.shape != self.shape:
            raise ValueError(f"cannot copy {host.shape} into {self.shape}")
        if host.size:
            cl.enqueue_copy(self.device.queue, self.buffer, host)

    def fill(self, value: float) -> None:
        """Set every value of an array of floats or 32-bit integers."""
        word = int(np.array(value, self.dtype).view(np.uint32))
        words = Array(self.device, self.buffer, self.shape, np.dtype(np.uint32))
        count = self.nbytes // 4
        self.device.program("fill.cl").fill_words(items=-(-count // 16), values=words, word=word, count=count)


class Device:
    """An open device: one context, one in-order queue, programs built once."""

    def __init__(self, info: DeviceInfo, schedule: Schedule = "auto") -> None:
        platform, number = info.place
        self.info = info
        self.context = cl.Context([_platforms()[platform].get_devices()[number]])
        self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        self.schedule = resolve_schedule(info, schedule)
        self.tuning = _tuning(info, self.schedule)
        self.timings = Timings()
        self.allocated = 0  # bytes of all buffers that are alive
        self.peak = 0  # the most there ever were
        self._programs: dict[tuple[Any, ...], Program] = {}

    @property
    def text(self) -> str:
        return f"{self.info.text}, {self.schedule} schedule"

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> Array:
        """Allocate without initialising.  Raises MemoryLimitError with the sizes involved."""
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
        array = self.empty(shape, dtype)
        array.fill(0)
        return array

    def upload(self, values: NDArray[Any]) -> Array:
        array = self.empty(values.shape, values.dtype)
        array.set(values)
        return array

    def program(self, file: str | Path, **defines: int | str) -> "Program":
        """Build `cl_kernels/<file>`, or a file by its absolute path, with this device's tuning and `defines`, once.

        Raises KernelError when it does not build, FileNotFoundError when it is missing.
        """
        from clsplat.opencl.program import Program

        key = (str(file), *sorted(defines.items()))
        if key not in self._programs:
            self._programs[key] = Program(self, file, {**self.tuning, **defines})
        return self._programs[key]

    def finish(self) -> None:
        """Wait until everything enqueued is done."""
        self.queue.finish()


def _whole_lines(size: int) -> int:
    """Bytes rounded up to 64, at least as many: vectors may run past the last value, and no buffer may be empty."""
    return max(64, -(-size // 64) * 64)


def resolve_schedule(info: DeviceInfo, schedule: Schedule) -> Literal["wide", "simt"]:
    """`auto`: CPUs with vector units of 8 floats or more take the wide schedule, everything else simt."""
    if schedule == "auto":
        return "wide" if info.kind == "CPU" and info.float_width >= 8 else "simt"
    if schedule not in ("wide", "simt"):
        raise ConfigError(f"no schedule named '{schedule}'; there are auto, wide and simt")
    return schedule


def _tuning(info: DeviceInfo, schedule: Literal["wide", "simt"]) -> dict[str, int | str]:
    """The -D values that fit kernels to a device; their meaning stands in cl_kernels/common.h."""
    if schedule == "wide":
        return {
            "LANES": 16 if info.float_width >= 16 else 8,
            "VECTORS": 4,
            "GROUP": 16,
            "TEAM": 1,
            "DIGIT_BITS": 11,
            "TILE": 16,
        }
    return {
        "LANES": 1,
        "VECTORS": 1,
        "GROUP": 64,
        "TEAM": 64,
        "DIGIT_BITS": 4,
        "TILE": 16 if info.group >= 256 else 8,
        "SORT_CAPACITY": 2048,
    }
