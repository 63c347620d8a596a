"""Find the OpenCL devices of this machine and choose one.

The device is chosen once and passed explicitly; clsplat never falls back to another device silently.
"""

import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, get_args

from clsplat.core.errors import ConfigError, DeviceError, one_line, quote
from clsplat.opencl import runtimes

runtimes.prepare()
import pyopencl as cl  # noqa: E402

DEVICE_VARIABLE = "CLSPLAT_DEVICE"
LOCAL_MEMORY = 32 << 10  # bytes that kernels may use per work-group; OpenCL 1.2, full profile
LOG = logging.getLogger("clsplat")
FixedSchedule = Literal["simt", "simt16", "wide"]
Schedule = Literal["auto", FixedSchedule]
SCHEDULES: tuple[FixedSchedule, ...] = get_args(FixedSchedule)


@dataclass(frozen=True)
class DeviceInfo:
    """The properties of a device, the index of its platform, and its index on that platform."""

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
    index: tuple[int, int]  # platform and device number
    clock: int = 0  # MHz, maximum
    unified: bool = False  # whether it shares the host's memory: an integrated GPU

    @property
    def label(self) -> str:
        return f"{self.name} ({self.kind}) on {self.platform}"

    def fault(self) -> str | None:
        """Return why the device does not work: small work-groups, or a failing test kernel; None if it works."""
        min_group = int(tuning_macros(self, resolve_schedule(self, "auto"))["GROUP"])
        if self.group < min_group:
            return f"its work-groups have at most {self.group} items; {min_group} are needed"
        if self.local_memory < LOCAL_MEMORY:
            return f"its work-groups have {self.local_memory} bytes of local memory; {LOCAL_MEMORY} are needed"
        return runtimes.probe_fault(f"{self.platform}|{self.name}|{self.driver}|{cl.VERSION_TEXT}", *self.index)

    def matches(self, device_name: str) -> bool:
        """Return whether "PLATFORM NAME KIND" of this device contains `device_name`, ignoring case."""
        return device_name.lower() in f"{self.platform} {self.name} {self.kind}".lower()


def list_devices() -> list[DeviceInfo]:
    """Return all devices of all runtimes, in the loader's order.

    A device that cannot be queried is omitted, with a warning.
    """
    infos = []
    for p, platform in enumerate(get_platforms()):
        devices: list[Any] = []
        with _warn_on_error(f"OpenCL platform {p}: its devices cannot be listed", "DEVICE_NOT_FOUND"):
            devices = platform.get_devices()
        for d, device in enumerate(devices):
            with _warn_on_error(f"OpenCL platform {p}: its device {d} cannot be queried"):
                infos.append(_query(platform, device, (p, d)))
    return infos


def get_platforms() -> list[Any]:
    """Return the platforms of the loader, or an empty list without runtimes.  Raises errors like `check_runtimes`."""
    runtimes.check_runtimes(f"{cl.VERSION_TEXT} {cl.__file__}")
    with _warn_on_error("the OpenCL loader fails", "PLATFORM_NOT_FOUND_KHR"):
        return list(cl.get_platforms())
    return []


@contextmanager
def _warn_on_error(message: str, expected_code: str = "") -> Iterator[None]:
    """Log an OpenCL error in the block as a warning, unless it has the expected code."""
    try:
        yield
    except cl.Error as error:
        if error.code != getattr(cl.status_code, expected_code, None):
            LOG.warning("%s (%s); its driver may need to be reinstalled", message, one_line(error))


def _query(platform: Any, device: Any, index: tuple[int, int]) -> DeviceInfo:
    kinds = cl.device_type
    return DeviceInfo(
        name=device.name.strip(),
        platform=f"{platform.name.strip()}, {_short_version(platform.version)}",
        kind="GPU" if device.type & kinds.GPU else "CPU" if device.type & kinds.CPU else "other",
        driver=device.driver_version.strip(),
        units=device.max_compute_units,
        memory=device.global_mem_size,
        allocation=device.max_mem_alloc_size,
        local_memory=device.local_mem_size,
        group=device.max_work_group_size,
        float_width=device.native_vector_width_float,
        index=index,
        clock=device.max_clock_frequency,
        unified=bool(device.host_unified_memory),
    )


def _short_version(version: str) -> str:
    """Shorten 'OpenCL 3.0 PoCL 3.1+debian  Linux, None+Asserts, ...' to 'OpenCL 3.0 PoCL 3.1+debian'."""
    return " ".join(version.split(",")[0].split()[:4])


def choose_device(device_name: str | None = None) -> DeviceInfo:
    """Choose a device, and log the devices that do not work.

    `device_name` is a part of a runtime's or device's name; a suffix `:n` selects the n-th match, counted from 0.  The
    default is the environment variable CLSPLAT_DEVICE, else the strongest GPU that works, else the first CPU, else the
    first other device.  Raises DeviceError if no device matches or works.
    """
    device_name = device_name or os.environ.get(DEVICE_VARIABLE)
    devices = list_devices()
    if not devices:
        raise runtimes.no_device_error("no OpenCL device was found", runtimes.no_device_advice())
    if device_name:
        return _find_by_name(device_name, devices)
    faults = []
    for info in sorted(devices, key=_rank):
        fault = info.fault()
        if fault is None:
            other_gpus = [
                device.label for device in devices if device.kind == info.kind == "GPU" and device is not info
            ]
            if other_gpus:
                LOG.info("using %s; other GPUs: %s; select one with --device NAME", info.label, "; ".join(other_gpus))
            return info
        faults.append(f"{info.label} does not work: {fault}")
        LOG.warning("%s", faults[-1])
    raise runtimes.no_device_error("; ".join(faults))


def _rank(info: DeviceInfo) -> tuple[int, bool, int]:
    """Return the sort key: GPUs (discrete first, by compute units times clock), then CPUs, then other devices.

    The number of units is not enough to compare GPUs, because vendors define compute units differently.
    """
    is_gpu = info.kind == "GPU"
    return ("GPU", "CPU", "other").index(info.kind), is_gpu and info.unified, -info.units * info.clock if is_gpu else 0


def _find_by_name(device_name: str, devices: list[DeviceInfo]) -> DeviceInfo:
    match = re.fullmatch(r"(.*):([0-9]{1,4})", device_name, re.DOTALL)
    name, number = match.groups() if match else (device_name, "0")
    candidates = [info for info in devices if info.matches(name)]
    if int(number) >= len(candidates):
        raise DeviceError(f"no device matches {quote(device_name)}; available: {'; '.join(i.label for i in devices)}")
    info = candidates[int(number)]
    fault = info.fault()
    if fault is not None:
        raise runtimes.no_device_error(f"{info.label} does not work: {fault}")
    return info


def resolve_schedule(info: DeviceInfo, schedule: Schedule) -> FixedSchedule:
    """Return the schedule for a device.  `auto` is `wide` for CPUs with vectors of 8 floats or more, else `simt`."""
    if schedule == "auto":
        return "wide" if info.kind == "CPU" and info.float_width >= 8 else "simt"
    if schedule not in SCHEDULES:
        raise ConfigError(f"unknown schedule '{schedule}'; expected auto, simt, simt16, or wide")
    return schedule


def tuning_macros(info: DeviceInfo, schedule: FixedSchedule) -> dict[str, int | str]:
    """Return the macros with which kernels are built for a device; cl_kernels/common.h explains them."""
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
        "TILE": 16 if schedule == "simt16" else 8,
    }
