"""Compare the kernels of a training step with the reference, once per device, driver, and kernel version."""

import hashlib
import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path

from clsplat.conformance.host import code_variables
from clsplat.conformance.supervision import run_checks
from clsplat.core.errors import DeviceError, MemoryLimitError, OutputError
from clsplat.core.files import write_text
from clsplat.core.machine import cache_folder
from clsplat.core.resources import __version__, resource_dir
from clsplat.opencl.device import BUILD_OPTIONS, Device, open_device
from clsplat.opencl.discovery import DeviceInfo, FixedSchedule, Schedule, tuning_macros
from clsplat.opencl.kernel_caches import kernel_cache_advice
from clsplat.render.tiles import Sort, resolve_sort

LOG = logging.getLogger("clsplat")
TIMEOUT_S = 300  # longest time without output from a check
SORTS = ("radix", "bitonic")  # each has a record


def open_verified(device: str | Device | None, schedule: Schedule = "auto", sort: Sort = "auto") -> Device:
    """Open a device as `open_device` does, log its name, and ensure that it computes correctly.

    Use this to open the device for rendering or training.
    """
    result = open_device(device, schedule)
    LOG.info("device: %s", result.label)
    ensure_correct(result, sort)
    return result


def ensure_correct(device: Device, sort: Sort = "auto") -> None:
    """Compare the essential kernels with the reference, on the first use of a device, driver, and kernel version.

    The checks run in a child process, so that the state of the open device does not change.  The bitonic sort is
    checked if the run may choose it.  Raises DeviceError if the results of the device are wrong, and MemoryLimitError
    if it has too little memory.
    """
    info, schedule = device.info, device.schedule
    uses_bitonic = resolve_sort(device, sort) != "radix"
    sorts = SORTS if uses_bitonic else SORTS[:1]
    if all(_record_file(info, schedule, name).exists() for name in sorts):
        return
    # slow to import, and not needed for a verified device
    from clsplat.conformance.checks import BITONIC, ESSENTIAL_CHECKS

    LOG.info("checking %s; this takes a few seconds, or longer if its compiler is slow", info.name)
    for result in run_checks(info, schedule, [*ESSENTIAL_CHECKS, *(BITONIC if uses_bitonic else [])], TIMEOUT_S):
        if result.out_of_memory:
            raise MemoryLimitError(f"{device.label}: {result.failures[0]}; close other programs that use its memory")
        if result.damaged_cache:
            raise DeviceError(f"{device.label}: {kernel_cache_advice()}")
        if not result.passes:
            verdict = "cannot be trusted" if result.fault else "computes wrong results"
            raise DeviceError(f"{device.label} {verdict}: {result.failures[0]}; run `clsplat doctor` for details")
    remember(info, schedule, sorts)


def remember(info: DeviceInfo, schedule: FixedSchedule, sorts: Sequence[str] = SORTS) -> None:
    """Record that a device computes correctly.  If the cache is not writable, the next run checks the device again."""
    with suppress(OutputError):
        for sort in sorts:
            write_text(_record_file(info, schedule, sort), f"{info.label}, {schedule}, {sort}\n")


def forget(info: DeviceInfo, schedule: FixedSchedule) -> None:
    """Remove the records of a device that computes wrong results, so that the next run checks it again."""
    for sort in SORTS:
        with suppress(OSError):
            _record_file(info, schedule, sort).unlink(missing_ok=True)


def _record_file(info: DeviceInfo, schedule: FixedSchedule, sort: str) -> Path:
    """Return the path of a record.

    Its name is a hash of everything that affects the results: checks, device, driver, kernels, and build options.
    """
    checks = (__version__, _hash_checks())
    device = (info.platform, info.name, info.driver, version("pyopencl"))
    build = (schedule, sort, BUILD_OPTIONS, sorted(tuning_macros(info, schedule).items()), _hash_kernels())
    key = repr((checks, device, build, code_variables()))
    return cache_folder() / "conformance" / hashlib.sha256(key.encode()).hexdigest()[:16]


@cache
def _hash_kernels() -> str:
    return _hash_files(resource_dir("cl_kernels").iterdir())


@cache
def _hash_checks() -> str:
    parent = Path(__file__).parent
    return _hash_files(path for folder in ("checks", "reference") for path in (parent / folder).glob("*.py"))


def _hash_files(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()
