"""Open an OpenCL device, allocate its memory, and build and launch its kernels.

Only this package imports pyopencl.
"""

import itertools
import math
import re
import sqlite3
import threading
import warnings
import weakref
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, ClassVar, NoReturn

import numpy as np
from numpy.typing import DTypeLike, NDArray

from clsplat.core.errors import ConfigError, DeviceError, KernelError, MemoryLimitError
from clsplat.core.resources import resource_dir
from clsplat.opencl import runtimes
from clsplat.opencl.discovery import DeviceInfo, Schedule, choose_device, get_platforms, resolve_schedule, tuning_macros
from clsplat.opencl.kernel_caches import kernel_caches, remove_broken_kernels

runtimes.prepare()
import pyopencl as cl  # noqa: E402

warnings.filterwarnings("ignore", category=cl.CompilerWarning)  # some runtimes warn at every build


@contextmanager
def raising_device_errors(action: str, device_name: str) -> Iterator[None]:
    """Convert OpenCL errors in the block to MemoryLimitError or DeviceError; `action` describes the block.

    Some runtimes allocate device memory on first use, so that a launch or a copy may be the first call to fail.
    """
    try:
        yield
    except cl.MemoryError as error:
        raise MemoryLimitError(
            f"{action}: {device_name} is out of memory ({error}); use fewer Gaussians or smaller images"
        ) from error
    except cl.Error as error:
        raise DeviceError(f"{action} failed on {device_name}: {error}") from error


class Timings:
    """Kernel times, measured by profiling events while `sampling` is True.

    Events are dropped as soon as they are read: some drivers slow down when many are alive.
    """

    def __init__(self, device_name: str) -> None:
        self.device_name = device_name
        self.sampling = False
        self.section = "other"  # current part of a step, for kernels that `records.STAGES` does not list
        self._events: list[tuple[str, str, Any]] = []

    def add(self, name: str, event: Any) -> None:
        if self.sampling:
            self._events.append((name, self.section, event))

    @property
    def launches(self) -> int:
        """The number of launches since the last call of `take`."""
        return len(self._events)

    def take(self) -> dict[tuple[str, str], list[float]]:
        """Return the seconds of each launch since the last call, by kernel and section.

        Waits for the launches.  Raises MemoryLimitError or DeviceError if a launch failed.
        """
        seconds: dict[tuple[str, str], list[float]] = defaultdict(list)
        for name, section, event in self._events:
            with raising_device_errors(name, self.device_name):
                event.wait()
                seconds[name, section].append((event.profile.end - event.profile.start) * 1e-9)
        self._events.clear()
        return seconds


class Buffer(cl.Buffer):
    """A buffer in device memory that, unlike pyopencl's class, supports weak references."""

    serial: int  # number that no other buffer has
    copy: Any  # event of the last copy that `set_later` enqueued


_SERIALS = itertools.count(1)


class Recording(threading.local):
    """The plan to which a thread's launches are added (`clsplat.opencl.plan`), or None."""

    plan: Any = None

    def invalidate(self) -> None:
        """Mark the plan as not replayable, because the part contains a command other than a launch."""
        if self.plan is not None:
            self.plan.is_replayable = False


class Array:
    """A typed array in device memory, without arithmetic."""

    __slots__ = ("buffer", "device", "dtype", "shape")

    def __init__(self, device: "Device", buffer: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        self.device, self.buffer, self.shape, self.dtype = device, buffer, shape, dtype

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    def get(self) -> NDArray[Any]:
        """Wait for the device, and copy the array to the host.  Raises MemoryLimitError, DeviceError."""
        host = np.empty(self.shape, self.dtype)
        self.device.recording.invalidate()
        if host.size:
            with self.device.raising_errors("a copy to the host"):
                cl.enqueue_copy(self.device.queue, host, self.buffer)
        return host

    def get_later(self) -> Callable[[], NDArray[Any]]:
        """Start a copy to the host, and return a function that waits for it and returns the values.

        The copy follows all work enqueued so far, and does not wait for later work.  Raises MemoryLimitError,
        DeviceError.
        """
        return self._copy_later(np.empty(self.shape, self.dtype))

    def _copy_later(self, host: NDArray[Any], **part: Any) -> Callable[[], NDArray[Any]]:
        self.device.recording.invalidate()
        with self.device.raising_errors("a copy to the host"):
            copy = cl.enqueue_copy(self.device.queue, host, self.buffer, is_blocking=False, **part)

        def wait() -> NDArray[Any]:
            with self.device.raising_errors("a copy to the host"):
                copy.wait()
            return host

        return wait

    def get_item(self, index: int) -> Any:
        """Copy one value of a one-dimensional array to the host, and wait for it, like `get`."""
        return self.get_item_later(index)()

    def get_item_later(self, index: int) -> Callable[[], Any]:
        """Start a copy of one value of a one-dimensional array to the host, like `get_later`."""
        wait = self._copy_later(np.empty(1, self.dtype), src_offset=index * self.dtype.itemsize)
        return lambda: wait()[0].item()

    def set(self, values: NDArray[Any]) -> None:
        """Copy values of the same shape from the host.  Raises ValueError, MemoryLimitError, DeviceError."""
        host = np.ascontiguousarray(values, self.dtype)
        if host.shape != self.shape:
            raise ValueError(f"cannot copy an array of shape {host.shape} into a buffer of shape {self.shape}")
        self.device.recording.invalidate()
        if host.size:
            with self.device.raising_errors("a copy to the device"):
                cl.enqueue_copy(self.device.queue, self.buffer, host)

    def set_later(self, values: NDArray[Any]) -> None:
        """Copy values of the same shape from the host, as `set` does, but enqueue the copy without waiting for it."""
        host = np.array(values, self.dtype).reshape(self.shape)
        self.device.recording.invalidate()
        with self.device.raising_errors("a copy to the device"):
            copy = cl.enqueue_copy(self.device.queue, self.buffer, host, is_blocking=False)
        self.buffer.copy = copy  # keep the event: pyopencl would wait for the copy if it were deleted

    def fill(self, value: float) -> None:
        """Set every value of an array of floats or 32-bit integers."""
        word = int(np.array(value, self.dtype).view(np.uint32))
        words = Array(self.device, self.buffer, self.shape, np.dtype(np.uint32))
        lines = -(-self.nbytes // 64)  # counts of words would overflow 32 bits from 16 GiB on
        self.device.program("fill.cl").fill_words(items=lines, values=words, word=word, lines=lines)


class Device:
    """An open OpenCL device with one context and an in-order queue; it builds each program only once.

    A `with` block waits for all work when it ends.  Memory is released with the arrays, and the device with the last
    object that uses it.

    `name` is a part of a runtime's or device's name, as printed by `clsplat devices`.  By default, the device is
    the one named in CLSPLAT_DEVICE, else the strongest GPU that works, else the first CPU.
    Raises DeviceError if there is none, MemoryLimitError or DeviceError if the runtime cannot open it.
    """

    def __init__(self, name: str | DeviceInfo | None = None, schedule: Schedule = "auto") -> None:
        info = name if isinstance(name, DeviceInfo) else choose_device(name)
        platform, number = info.index
        self.info = info
        remove_broken_kernels()
        flags = cl.command_queue_properties.PROFILING_ENABLE
        with self.raising_errors("opening the device"):
            self.context = create_context(get_platforms()[platform].get_devices()[number])
            self._queues = {False: cl.CommandQueue(self.context), True: cl.CommandQueue(self.context, properties=flags)}
        self._sampling = False  # whether the profiling queue is in use, which costs host time
        self.schedule = resolve_schedule(info, schedule)
        self.tuning = tuning_macros(info, self.schedule)
        self.timings = Timings(info.name)
        self.allocated = 0  # bytes of all buffers that are alive
        self.peak = 0  # largest value of `allocated`
        self.lock = threading.Lock()  # protects what threads share: programs, and the arguments of their kernels
        self.recording = Recording()
        self._programs: dict[tuple[Any, ...], Program] = {}

    def __enter__(self) -> "Device":
        return self

    def __exit__(self, *error: object) -> None:
        self.finish()

    def __repr__(self) -> str:
        return f"Device({self.label!r})"

    @property
    def label(self) -> str:
        return f"{self.info.label}, {self.schedule} schedule"

    @property
    def queue(self) -> Any:
        """The command queue: one with profiling while `timings` samples, otherwise one without.

        After a switch, the new queue waits for the commands of the other on the device, without blocking the host.
        """
        sampling = self.timings.sampling
        if sampling != self._sampling:
            marker = cl.enqueue_marker(self._queues[self._sampling])
            self._queues[self._sampling].flush()
            cl.enqueue_barrier(self._queues[sampling], wait_for=[marker])
            self._sampling = sampling
        return self._queues[sampling]

    def empty(self, shape: int | tuple[int, ...], dtype: DTypeLike = np.float32) -> Array:
        """Allocate an array with undefined values.  Raises MemoryLimitError."""
        shape = (shape,) if isinstance(shape, int) else shape
        element_type = np.dtype(dtype)
        size = _round_up_to_lines(math.prod(shape) * element_type.itemsize)
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
        buffer.serial = next(_SERIALS)
        self.recording.invalidate()
        self.allocated += size
        self.peak = max(self.peak, self.allocated)
        weakref.finalize(buffer, self._record_release, size)
        return Array(self, buffer, shape, element_type)

    def _record_release(self, size: int) -> None:
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
        """Return the program of `cl_kernels/<file>`, or of an absolute path.  It is built once per set of macros.

        The macros are this device's tuning and `defines`.  Raises KernelError if the file is missing or does not build.
        """
        key = (str(file), *defines.items(), *self.tuning.items())
        with self.lock:
            if key not in self._programs:
                self._programs[key] = Program(self, file, {**self.tuning, **defines})
            return self._programs[key]

    def finish(self) -> None:
        """Wait for all enqueued work.  Raises MemoryLimitError, DeviceError."""
        with self.raising_errors("enqueued work"):
            self.queue.finish()

    def raising_errors(self, action: str) -> AbstractContextManager[None]:
        """Convert OpenCL errors in the block, which `action` describes (see `raising_device_errors`)."""
        return raising_device_errors(action, self.info.name)


def create_context(device: Any) -> Any:
    """Return a new context for a device of pyopencl."""
    return cl.Context([device])


def open_device(device: str | Device | None = None, schedule: Schedule = "auto") -> Device:
    """Open the device whose name contains `device`, by default the one that `choose_device` selects.

    An open Device is returned unchanged.  Raises DeviceError if no device matches, and ConfigError for an open
    device with another schedule.
    """
    if device is None or isinstance(device, str):
        return Device(device, schedule)
    if not isinstance(device, Device):
        raise ConfigError(f"device: expected part of a device name, or a Device, got {type(device).__name__}")
    if schedule != "auto" and resolve_schedule(device.info, schedule) != device.schedule:
        raise ConfigError(
            f"device: is open as {device.label}; the settings need {schedule}: open it with schedule='{schedule}'"
        )
    return device


def _round_up_to_lines(size: int) -> int:
    """Round a size up to a positive multiple of 64 bytes, because vector loads may read past the end of a buffer."""
    return max(64, -(-size // 64) * 64)


# Kernels: build a .cl file, check the arguments of calls against its source, and launch.


CACHE_ERRORS = (cl.Error, sqlite3.Error, UnpicklingError)  # raised if a cache of the runtime or pyopencl is damaged
BUILD_OPTIONS = ("-cl-std=CL1.2",)

_INCLUDE = re.compile(r'^#include "(\w+\.h)"')
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*", re.DOTALL)
_KERNEL = re.compile(
    r"__kernel\s+__attribute__\(\(reqd_work_group_size\([^)]*\)\)\)\s*void\s+(?P<name>\w+)\s*\((?P<arguments>[^)]*)\)"
)
_POINTER = re.compile(r"__(?:global|constant)\s+(?:const\s+)?(?P<type>\w+)\s*\*\s*restrict\s+(?P<name>\w+)")
_SCALAR = re.compile(r"const\s+(?P<type>float|uint|int)\s+(?P<name>\w+)")
_DEFINE = re.compile(r"^#define (\w+) +(\(?[-0-9.][-+\w.]*(?: / [-+\w.]+)?\)?)[ ]*(?://.*)?$", re.MULTILINE)
_TYPES: dict[str, np.dtype[Any]] = {
    "float": np.dtype(np.float32),
    "uint": np.dtype(np.uint32),
    "int": np.dtype(np.int32),
    "uchar": np.dtype(np.uint8),
}


def flatten(path: Path, headers: set[Path] | None = None) -> str:
    """Return the source with each local header inlined once, and #line directives for correct compiler messages.

    headers: the headers that are already inlined; new ones are added.
    """
    headers = set() if headers is None else headers
    text = [f'#line 1 "{path.name}"']
    for number, line in enumerate(path.read_text("utf-8").splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            text.append(line)
            continue
        header = path.parent / match[1]
        if not header.is_file():  # a plug-in's kernels may include the package's headers
            header = resource_dir("cl_kernels") / match[1]
        if header not in headers:
            headers.add(header)
            text.append(flatten(header, headers))
        text.append(f'#line {number + 1} "{path.name}"')
    return "\n".join(text)


@cache
def constants(file: str = "common.h") -> dict[str, float]:
    """Return the numeric #defines of a kernel file by name."""
    text = (resource_dir("cl_kernels") / file).read_text("utf-8")
    values = {}
    for name, value in _DEFINE.findall(text):
        numerator, _, denominator = value.strip("()").partition(" / ")
        values[name] = float(numerator.rstrip("fu")) / float(denominator.rstrip("fu") or 1)
    return values


@dataclass(frozen=True)
class Argument:
    """One parameter of a kernel."""

    name: str
    dtype: np.dtype[Any] | None  # None: a struct, whose layout a test checks
    is_pointer: bool


def parse_kernels(source: str) -> dict[str, list[Argument]]:
    """Return the parameters of each kernel in a source text.  Raises KernelError for unsupported declarations."""
    kernels = {}
    for match in _KERNEL.finditer(_COMMENT.sub("", source)):
        kernels[match["name"]] = [_parse_argument(match["name"], a) for a in match["arguments"].split(",")]
    return kernels


def _parse_argument(kernel: str, text: str) -> Argument:
    pointer, scalar = _POINTER.fullmatch(text.strip()), _SCALAR.fullmatch(text.strip())
    if pointer:
        return Argument(pointer["name"], _TYPES.get(str(pointer["type"])), True)
    if scalar:
        return Argument(scalar["name"], _TYPES[str(scalar["type"])], False)
    raise KernelError(f"{kernel}: cannot parse the parameter '{text.strip()}'")


def group_limit(kernel: Any, device: Any) -> int:
    """Return the size of the largest work-group that the compiler allows for a kernel."""
    return int(kernel.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, device))


def underreports_group_limit(info: DeviceInfo, limit: int, multiple: int) -> bool:
    """Return whether a runtime reports a group size limit that is too small, as rusticl does.

    It reports `multiple`, the number of work-items that run together, but supports larger groups.  Mesa 22.3.6 reports
    32 for a kernel that requires 256.
    https://gitlab.freedesktop.org/mesa/mesa/-/blob/mesa-22.3.6/src/gallium/frontends/rusticl/api/kernel.rs
    """
    return info.platform.startswith("rusticl") and limit == multiple


def group_multiple(kernel: Any, device: Any) -> int:
    """Return the number of work-items that a device runs together.  Group sizes should be a multiple of this number."""
    return int(kernel.get_work_group_info(cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE, device))


class Kernel:
    """A kernel that is called with named arguments."""

    def __init__(self, device: "Device", label: str, create: Callable[[], Any], arguments: list[Argument]) -> None:
        self.label, self.arguments = label, arguments
        self.spare_kernels: list[Any] = []  # unused copies of the kernel, for new plans
        self._device, self._create = device, create
        self._kernel = kernel = self.take()
        info, cl_device = cl.kernel_work_group_info, device.context.devices[0]
        self.group = tuple(int(n) for n in kernel.get_work_group_info(info.COMPILE_WORK_GROUP_SIZE, cl_device))
        items, limit = math.prod(self.group), group_limit(kernel, cl_device)
        if items > limit and not underreports_group_limit(device.info, limit, group_multiple(kernel, cl_device)):
            raise KernelError(
                f"{label} needs work-groups of {items} items, but {device.info.label} allows {limit}; "
                "use another device, rasterizer.schedule, or rasterizer.sort"
            )

    def take(self) -> Any:
        """Return a copy of the kernel for one launch, so that no other launch changes its arguments."""
        if self.spare_kernels:
            return self.spare_kernels.pop()
        kernel = self._create()
        kernel.set_scalar_arg_dtypes([None if a.is_pointer else a.dtype for a in self.arguments])
        return kernel

    def __call__(self, *, items: int | tuple[int, ...] = 0, groups: int | tuple[int, ...] = 0, **values: Any) -> None:
        """Launch `items` work-items, rounded up to full work-groups, or `groups` work-groups; none if a size is 0."""
        total = items or groups
        size = (total,) if isinstance(total, int) else total
        local = self.group[: len(size)]
        if items:
            size = tuple(-(-n // g) * g for n, g in zip(size, local, strict=True))
        else:
            size = tuple(n * g for n, g in zip(size, local, strict=True))
        if 0 in size:
            return
        arguments, plan = self._check_arguments(values), self._device.recording.plan
        with self._device.lock, self._device.raising_errors(self.label):  # arguments must not change before the launch
            if plan is None:
                self._kernel.set_args(*arguments)
            kernel = plan.add(self, size, local, arguments) if plan else self._kernel
            event = cl.enqueue_nd_range_kernel(self._device.queue, kernel, size, local)
        self._device.timings.add(self.label, event)

    def _check_arguments(self, values: dict[str, Any]) -> list[Any]:
        if len(values) != len(self.arguments):
            self._raise_argument_error(values)
        result = []
        for argument in self.arguments:
            value = values.get(argument.name)
            if not argument.is_pointer and value is not None:
                result.append(value)
            elif isinstance(value, Array) and (argument.dtype is None or value.dtype == argument.dtype):
                result.append(value.buffer)
            else:
                self._raise_argument_error(values)
        return result

    def _raise_argument_error(self, values: dict[str, Any]) -> NoReturn:
        expected = {a.name: a for a in self.arguments}
        missing, unexpected = expected.keys() - values.keys(), values.keys() - expected.keys()
        mismatches = [
            f"{name} is {getattr(value, 'dtype', type(value).__name__)}, expected {expected[name].dtype or 'a struct'}"
            for name, value in values.items()
            if name in expected and expected[name].is_pointer and getattr(value, "dtype", None) != expected[name].dtype
        ]
        faults = [f"missing arguments {', '.join(sorted(missing))}"] if missing else []
        faults += [f"unknown arguments {', '.join(sorted(unexpected))}"] if unexpected else []
        raise KernelError(f"{self.label}: {'; '.join(faults + mismatches)}")


class Program:
    """A built .cl file, with its kernels as attributes."""

    options: ClassVar[tuple[str, ...]] = BUILD_OPTIONS  # tests add -Werror; users' drivers may warn

    def __init__(self, device: "Device", file: str | Path, defines: dict[str, int | str]) -> None:
        path = resource_dir("cl_kernels") / file  # an absolute path stays as it is
        if not path.is_file():
            raise KernelError(f"{path}: no such kernel file")
        source = flatten(path)
        options = [*self.options, *(f"-D{name}={value}" for name, value in sorted(defines.items()))]
        try:
            program = build(device.context, source, tuple(options))
        except cl.Error as error:
            raise KernelError(
                f"{file} does not build on {device.label} with {' '.join(options)}: {_first_error(error)}"
            ) from error
        try:
            self.kernels = {
                name: Kernel(device, f"{path.name}:{name}", partial(cl.Kernel, program, name), arguments)
                for name, arguments in parse_kernels(source).items()
            }
        except CACHE_ERRORS as error:
            raise KernelError(
                f"{file} was built on {device.label}, but its kernels cannot be created ({error}); the cache of built "
                f"kernels may be damaged: remove {kernel_caches()}"
            ) from error
        names = program.get_info(cl.program_info.KERNEL_NAMES).split(";")
        if unparsed_names := sorted({name for name in names if name} - self.kernels.keys()):
            raise KernelError(
                f"{path}: cannot parse the declaration of {', '.join(unparsed_names)}; expected "
                f"'__kernel __attribute__((reqd_work_group_size(64, 1, 1))) void {unparsed_names[0]}(' "
                "and parameters like '__global const float *restrict means' and 'const uint count'"
            )

    def __getattr__(self, name: str) -> Kernel:
        kernels: dict[str, Kernel] = self.__dict__.get("kernels", {})
        if name not in kernels:
            raise AttributeError(f"no kernel named '{name}'")
        return kernels[name]


def build(context: Any, source: str, options: tuple[str, ...]) -> Any:
    """Build a program for a context."""
    return cl.Program(context, source).build(list(options))


def _first_error(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if not line.startswith("clBuild")]
    return next((line for line in lines if "error" in line.lower()), str(error)[:300])
