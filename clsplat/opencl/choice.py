"""Which OpenCL devices there are, and which one is chosen.  Nothing falls back to another one in silence."""

import logging
import os
import re
from dataclasses import dataclass
from typing import Any, Literal

from clsplat.errors import ConfigError, DeviceError
from clsplat.opencl import runtimes

runtimes.add_intel_runtime()
import pyopencl as cl  # noqa: E402

DEVICE_VARIABLE = "CLSPLAT_DEVICE"
LOG = logging.getLogger("clsplat")
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
    for p, platform in enumerate(platforms()):
        try:
            devices = platform.get_devices()
        except cl.Error:
            continue
        for d, device in enumerate(devices):
            found.append(_info(platform, device, (p, d)))
    return found


def platforms() -> list[Any]:
    """Return the runtimes, in the loader's order."""
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


def resolve_schedule(info: DeviceInfo, schedule: Schedule) -> Literal["wide", "simt"]:
    """`auto`: CPUs with vector units of 8 floats or more take the wide schedule, everything else simt."""
    if schedule == "auto":
        return "wide" if info.kind == "CPU" and info.float_width >= 8 else "simt"
    if schedule not in ("wide", "simt"):
        raise ConfigError(f"no schedule named '{schedule}'; there are auto, wide and simt")
    return schedule
