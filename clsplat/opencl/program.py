"""Kernels by name: load a .cl file, build it, check arguments against its text, launch.

Arguments are passed by the names in the kernel's signature; missing, surplus or wrongly typed ones raise KernelError.
"""

import math
import re
import sqlite3
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

import numpy as np
import pyopencl as cl

from clsplat.errors import KernelError
from clsplat.opencl.device import Array
from clsplat.opencl.discovery import DeviceInfo
from clsplat.opencl.kernel_caches import kernel_caches
from clsplat.version import resource_dir

if TYPE_CHECKING:
    from clsplat.opencl.device import Device

DAMAGES = (cl.Error, sqlite3.Error, UnpicklingError)  # where a kernel is made: of a runtime's cache, and of pyopencl's
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


def flatten(path: Path, seen: set[Path] | None = None) -> str:
    """Return the source with each local header inlined once; #line keeps file and line right in compiler messages."""
    seen = set() if seen is None else seen
    text = [f'#line 1 "{path.name}"']
    for number, line in enumerate(path.read_text("utf-8").splitlines(), start=1):
        match = _INCLUDE.match(line)
        if match is None:
            text.append(line)
            continue
        header = path.parent / match[1]
        if not header.is_file():  # kernels of a plug-in may include the package's headers
            header = resource_dir("cl_kernels") / match[1]
        if header not in seen:
            seen.add(header)
            text.append(flatten(header, seen))
        text.append(f'#line {number + 1} "{path.name}"')
    return "\n".join(text)


@cache
def constants(file: str = "common.h") -> dict[str, float]:
    """Return the numeric #defines of a header, for use in Python."""
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
    dtype: np.dtype[Any] | None  # None: a struct, whose layout a test compares
    pointer: bool


def parse_kernels(source: str) -> dict[str, list[Argument]]:
    """Return the parameters of every kernel in the source text.  Raises KernelError for other declarations."""
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
    raise KernelError(f"{kernel}: cannot read the parameter '{text.strip()}'")


def group_limit(kernel: Any, device: Any) -> int:
    """Return the items of the largest work-group that the compiler allows a kernel."""
    return int(kernel.get_work_group_info(cl.kernel_work_group_info.WORK_GROUP_SIZE, device))


def understates_groups(info: DeviceInfo, most: int, together: int) -> bool:
    """Return whether a limit is that of rusticl, which gives the items that run together for the largest group of any
    kernel and runs larger ones: Mesa 22.3.6 says 32 of a kernel that requires 256.
    https://gitlab.freedesktop.org/mesa/mesa/-/blob/mesa-22.3.6/src/gallium/frontends/rusticl/api/kernel.rs
    """
    return info.platform.startswith("rusticl") and most == together


def group_multiple(kernel: Any, device: Any) -> int:
    """Return the number of items that a device runs together, of whose multiples groups should be."""
    return int(kernel.get_work_group_info(cl.kernel_work_group_info.PREFERRED_WORK_GROUP_SIZE_MULTIPLE, device))


class Kernel:
    """A kernel that is called with named arguments."""

    def __init__(self, device: "Device", label: str, kernel: Any, arguments: list[Argument]) -> None:
        self.label, self.arguments = label, arguments
        self._device, self._kernel = device, kernel
        self._kernel.set_scalar_arg_dtypes([None if a.pointer else a.dtype for a in arguments])
        info, opened = cl.kernel_work_group_info, device.context.devices[0]
        self.group = tuple(int(n) for n in kernel.get_work_group_info(info.COMPILE_WORK_GROUP_SIZE, opened))
        items, most = math.prod(self.group), group_limit(kernel, opened)
        if items > most and not understates_groups(device.info, most, group_multiple(kernel, opened)):
            raise KernelError(
                f"{label} has work-groups of {items} items, and {device.info.text} allows it {most}; "
                "use another device, rasterizer.schedule or rasterizer.sort"
            )

    def __call__(self, *, items: int | tuple[int, ...] = 0, groups: int | tuple[int, ...] = 0, **values: Any) -> None:
        """Launch over `items`, rounded up to whole groups, or `groups` of the kernel's own size; none: no launch."""
        amount = items or groups
        size = (amount,) if isinstance(amount, int) else amount
        local = self.group[: len(size)]
        if items:
            size = tuple(-(-n // g) * g for n, g in zip(size, local, strict=True))
        else:
            size = tuple(n * g for n, g in zip(size, local, strict=True))
        if 0 in size:
            return
        arguments = self._checked(values)
        with (
            self._device.lock,
            self._device.refusals(self.label),
        ):  # the kernel holds the arguments until it is enqueued
            self._kernel.set_args(*arguments)
            event = cl.enqueue_nd_range_kernel(self._device.queue, self._kernel, size, local)
        self._device.timings.add(self.label, event)

    def _checked(self, values: dict[str, Any]) -> list[Any]:
        if len(values) != len(self.arguments):
            self._complain(values)
        checked = []
        for argument in self.arguments:
            value = values.get(argument.name)
            if not argument.pointer and value is not None:
                checked.append(value)
            elif isinstance(value, Array) and (argument.dtype is None or value.dtype == argument.dtype):
                checked.append(value.buffer)
            else:
                self._complain(values)
        return checked

    def _complain(self, values: dict[str, Any]) -> NoReturn:
        expected = {a.name: a for a in self.arguments}
        missing, surplus = expected.keys() - values.keys(), values.keys() - expected.keys()
        wrong = [
            f"{name} is {getattr(value, 'dtype', type(value).__name__)}, expected {expected[name].dtype or 'a struct'}"
            for name, value in values.items()
            if name in expected and expected[name].pointer and getattr(value, "dtype", None) != expected[name].dtype
        ]
        parts = [f"missing {', '.join(sorted(missing))}"] if missing else []
        parts += [f"surplus {', '.join(sorted(surplus))}"] if surplus else []
        raise KernelError(f"{self.label}: {'; '.join(parts + wrong)}")


class Program:
    """One .cl file, built; its kernels are attributes."""

    options: ClassVar[tuple[str, ...]] = BUILD_OPTIONS  # tests add -Werror; drivers of users may warn

    def __init__(self, device: "Device", file: str | Path, defines: dict[str, int | str]) -> None:
        path = resource_dir("cl_kernels") / file  # an absolute path stays as it is
        if not path.is_file():
            raise KernelError(f"{path}: no such kernel file")
        source = flatten(path)
        options = [*self.options, *(f"-D{name}={value}" for name, value in sorted(defines.items()))]
        try:
            program = built(device.context, source, tuple(options))
        except cl.Error as error:
            raise KernelError(
                f"{file} does not build on {device.text} with {' '.join(options)}: {_first_error(error)}"
            ) from error
        try:
            self.kernels = {
                name: Kernel(device, f"{path.name}:{name}", cl.Kernel(program, name), arguments)
                for name, arguments in parse_kernels(source).items()
            }
        except DAMAGES as error:
            raise KernelError(
                f"{file} was built on {device.text}, and its kernels cannot be made ({error}); the cache of built "
                f"kernels may be damaged: remove {kernel_caches()}"
            ) from error
        names = program.get_info(cl.program_info.KERNEL_NAMES).split(";")
        if unread := sorted({name for name in names if name} - self.kernels.keys()):
            raise KernelError(
                f"{path}: cannot read the head of {', '.join(unread)}; expected "
                f"'__kernel __attribute__((reqd_work_group_size(64, 1, 1))) void {unread[0]}(' "
                "and parameters like '__global const float *restrict means' and 'const uint count'"
            )

    def __getattr__(self, name: str) -> Kernel:
        kernels: dict[str, Kernel] = self.__dict__.get("kernels", {})
        if name not in kernels:
            raise AttributeError(f"no kernel named '{name}'")
        return kernels[name]


def built(context: Any, source: str, options: tuple[str, ...]) -> Any:
    """Return a program that is built for a context."""
    return cl.Program(context, source).build(list(options))


def _first_error(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if not line.startswith("clBuild")]
    return next((line for line in lines if "error" in line.lower()), str(error)[:300])
