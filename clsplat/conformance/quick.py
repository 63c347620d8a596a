"""The two-second form: the kernels of a training step on one small scene, once for a device, driver and kernels."""

import hashlib
import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from clsplat.caches import cache_folder
from clsplat.conformance import uses
from clsplat.conformance.host import code_variables
from clsplat.conformance.supervision import supervised
from clsplat.errors import DeviceError, MemoryLimitError, OutputError
from clsplat.files import write_text
from clsplat.opencl.device import Device, open_device
from clsplat.opencl.discovery import DeviceInfo, Schedule, tuning_of
from clsplat.opencl.kernel_caches import damaged_kernels
from clsplat.opencl.program import BUILD_OPTIONS
from clsplat.render.tiles import Sort, known_sort
from clsplat.version import __version__, resource_dir

LOG = logging.getLogger("clsplat")
QUICK_SECONDS = 300  # without a word from a check, in front of a run
Resolved = Literal["wide", "simt"]
SORTS = ("radix", "bitonic")  # each with a record of its own


def open_correct(device: str | Device | None, schedule: Schedule = "auto", sort: Sort = "auto") -> Device:
    """Open a device as `open_device` does, say which it is, and ensure that it computes correctly.

    Whatever makes pictures or models opens its device here.
    """
    opened = open_device(device, schedule)
    LOG.info("device: %s", opened.text)
    ensure_correct(opened, sort)
    return opened


def ensure_correct(device: Device, sort: Sort = "auto") -> None:
    """Compare the essential kernels with the reference when this device, driver and kernels meet for the first time.

    It happens in a process of its own, so that nothing of the device changes; the bitonic sort is checked where the run
    may choose it.  After a process that used the device and ended without a word, the comparison is repeated.
    Raises DeviceError when the device computes wrongly, MemoryLimitError.
    """
    info, schedule = device.info, device.schedule
    bitonic = known_sort(device, sort) != "radix"
    sorts = SORTS if bitonic else SORTS[:1]
    records = [_record(info, schedule, one) for one in sorts]
    uses.forget_after_sudden_ends(cache_folder())
    if all(record.exists() for record in records):
        uses.begin(records)
        return
    from clsplat.conformance.checks import BITONIC, ESSENTIAL  # a run on a device that is known needs no reference

    LOG.info("checking %s; this takes some seconds, more where it builds slowly", info.name)
    for result in supervised(info, schedule, [*ESSENTIAL, *(BITONIC if bitonic else [])], QUICK_SECONDS):
        if result.out_of_memory:
            raise MemoryLimitError(f"{device.text}: {result.failures[0]}; end other programs that use its memory")
        if result.damaged_cache:
            raise DeviceError(f"{device.text}: {damaged_kernels()}")
        if not result.holds:
            how = "cannot be trusted" if result.fault else "computes wrongly"
            raise DeviceError(f"{device.text} {how}: {result.failures[0]}; `clsplat doctor` tells more")
    remember(info, schedule, sorts)
    uses.begin(records)


def remember(info: DeviceInfo, schedule: Resolved, sorts: Sequence[str] = SORTS) -> None:
    """Note that a device computes what the reference says; where the cache cannot be written, it is checked again."""
    with suppress(OutputError):
        for sort in sorts:
            write_text(_record(info, schedule, sort), f"{info.text}, {schedule}, {sort}\n")


def forget(info: DeviceInfo, schedule: Resolved) -> None:
    """Remove the notes of a device that was found wrong: the next run checks it again."""
    for sort in SORTS:
        with suppress(OSError):
            _record(info, schedule, sort).unlink(missing_ok=True)


def _record(info: DeviceInfo, schedule: Resolved, sort: str) -> Path:
    """A file for all that decides what was found: the checks, the driver, what is compiled for the device, and how."""
    checks = (__version__, _hash_of_checks())
    device = (info.platform, info.name, info.driver, version("pyopencl"))
    build = (schedule, sort, BUILD_OPTIONS, sorted(tuning_of(info, schedule).items()), _hash_of_kernels())
    decisive = repr((checks, device, build, code_variables()))
    return cache_folder() / "conformance" / hashlib.sha256(decisive.encode()).hexdigest()[:16]


@cache
def _hash_of_kernels() -> str:
    return _hash_of(resource_dir("cl_kernels").iterdir())


@cache
def _hash_of_checks() -> str:
    here = Path(__file__).parent
    return _hash_of(path for folder in ("checks", "reference") for path in (here / folder).glob("*.py"))


def _hash_of(files: Iterable[Path]) -> str:
    together = hashlib.sha256()
    for path in sorted(files):
        together.update(path.name.encode() + path.read_bytes())
    return together.hexdigest()
