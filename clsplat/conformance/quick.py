"""The two-second form: the kernels of a training step on one small scene, once for a device, driver and kernels."""

import atexit
import hashlib
import json
import logging
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Literal

from clsplat.conformance.host import code_variables
from clsplat.conformance.supervision import supervised
from clsplat.core.errors import DataError, DeviceError, MemoryLimitError, OutputError
from clsplat.core.files import write_text
from clsplat.core.machine import Owner, cache_folder
from clsplat.core.reading import read_json
from clsplat.core.resources import __version__, resource_dir
from clsplat.opencl.device import BUILD_OPTIONS, Device, open_device
from clsplat.opencl.discovery import DeviceInfo, Schedule, tuning_of
from clsplat.opencl.kernel_caches import damaged_kernels
from clsplat.render.tiles import Sort, known_sort

# Uses of a device in progress: after one that ended without a word, as with a signal, the device is checked again.

FOLDER = "in_use"
_own: set[Path] = set()  # marks of this process


def begin(records: Sequence[Path]) -> None:
    """Mark the records of a device as in use by this process, until it ends in an orderly way."""
    folder, owner = records[0].parent.parent / FOLDER, Owner.current()
    place = hashlib.sha256(repr(owner).encode()).hexdigest()[:8]  # containers with one cache have equal numbers
    mark = folder / f"{owner.process}-{place}-{records[0].name}.json"
    if mark not in _own:
        with suppress(OutputError):
            write_text(mark, json.dumps({**asdict(owner), "records": [record.name for record in records]}))
            _own.add(mark)
            atexit.register(_end, mark)


def forget_after_sudden_ends(cache: Path) -> None:
    """Remove the records in a folder of caches that a process used which has ended and left its mark."""
    for mark in {*(cache / FOLDER).glob("*.json")} - _own:
        try:
            values = read_json(mark)
        except DataError:
            continue
        owner = Owner.from_record(values) if isinstance(values, dict) else None
        # the first process of every container has the same number
        if owner is not None and (owner.process == os.getpid() or owner.has_ended):
            with suppress(OSError):
                names = values.get("records")
                for name in names if isinstance(names, list) else ():
                    with suppress(ValueError):  # no name of a file
                        (cache / "conformance" / Path(str(name)).name).unlink(missing_ok=True)
                mark.unlink(missing_ok=True)


def _end(mark: Path) -> None:
    with suppress(OSError):
        mark.unlink(missing_ok=True)


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
    forget_after_sudden_ends(cache_folder())
    if all(record.exists() for record in records):
        begin(records)
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
    begin(records)


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
