"""How many runs share a CPU, and which cores each has."""

import logging
from collections.abc import Sequence
from typing import Literal

from clsplat import cores
from clsplat.bench.packing import known_packing, told
from clsplat.conformance.host import available_memory
from clsplat.errors import ConfigError, amount
from clsplat.opencl.discovery import DeviceInfo

LOG = logging.getLogger("clsplat")
Packing = int | Literal["auto"]
Parts = list[tuple[int, ...]]  # the cores of each run; one without cores has all, and is not kept to any


def shares_of(devices: Sequence[DeviceInfo], packing: Packing) -> list[Parts]:
    """Return the cores of the runs of each device, and say what was chosen by a measurement.

    A device that is no CPU has one run.  With "auto" so has each of several CPU devices, for they share the cores.
    Raises ConfigError for more runs than cores.
    """
    own = cores.usable()
    if packing != "auto" and packing > len(own):
        raise ConfigError(f"execution.packing: {packing} runs cannot share {amount(len(own), 'core')}; expected fewer")
    is_only = sum(info.kind == "CPU" for info in devices) == 1
    return [_parts(info, own, packing, is_only) if info.kind == "CPU" else [()] for info in devices]


def memory_of_each(info: DeviceInfo, runs: int) -> int:
    """Return the bytes that each of the runs of a device may take: of a CPU they share what the host has free."""
    if runs == 1:
        return info.memory
    free = available_memory()
    return info.memory // runs if free is None else min(info.memory, free // runs)


def _parts(info: DeviceInfo, own: tuple[int, ...], packing: Packing, is_only: bool) -> Parts:
    if packing == "auto":
        packing = _measured(info) if is_only and len(own) > 1 else 1
    return cores.shares(own, packing) if packing > 1 else [()]


def _measured(info: DeviceInfo) -> int:
    known = known_packing(info)
    how = "by `clsplat bench --packing`" if known else "`clsplat bench --packing` would tell whether several are faster"
    LOG.info("%s: %s; %s", info.text, told(known or 1), how)
    return known or 1
