"""Find devices and their bits classes.  A bits class is the hash of a fixed run's results.

The name of a device is not enough, because different runtimes may compute the same bits, and the same runtime may
compute different bits on another processor.  Devices of the same class can continue each other's cells.
"""

import json
import logging
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.core import machine
from clsplat.core.child import run_module
from clsplat.core.errors import ConfigError, DataError, DeviceError, OutputError, pluralize
from clsplat.core.files import write_text
from clsplat.core.machine import Owner, cache_folder
from clsplat.core.manifest import hash_values
from clsplat.core.reading import read_json, sha256
from clsplat.opencl.discovery import DeviceInfo, choose_device, list_devices
from clsplat.opencl.runtimes import no_device_error
from clsplat.pipeline.files import shipped_pipelines
from clsplat.sweeps.cell import code_digest

LOG = logging.getLogger("clsplat")
CoreSets = list[tuple[int, ...]]  # for each run, the cores that it is pinned to; (): all cores


def split_device_cores(devices: Sequence[DeviceInfo], packing: int) -> list[CoreSets]:
    """Assign CPU cores to the runs on each device; return a list of the runs' cores for each device.

    packing: number of runs on a CPU; other devices have one run.  Raises ConfigError if there are more runs than cores.
    """
    cores = machine.usable_cores()
    if packing > len(cores):
        raise ConfigError(
            f"execution.packing: {packing} runs cannot share {pluralize(len(cores), 'core')}; set at most {len(cores)}"
        )
    core_sets: CoreSets = machine.split_cores(cores, packing) if packing > 1 else [()]
    return [core_sets if info.kind == "CPU" else [()] for info in devices]


METRIC_KEY = "clsplat"  # name of the Dask metric in which a worker describes its device
CLASS_DIGITS = 8  # number of hexadecimal digits of a bits class
RUN_TIMEOUT_S = 600.0  # maximum time of the fixed run; some runtimes need minutes to build kernels
CHECK_DEVICE = "check the device with `clsplat doctor`"
SCENE_OPTIONS = ("--size", "48", "--train", "8", "--test", "2", "--seed", "0")
PIPELINE = "smoke"  # includes growth and opacity resets; SETTINGS add all SH bands and both filters
SETTINGS = (
    "model.sh_degree=3",
    "model.world_filter={type: smoothing, variance: 0.2}",
    "model.screen_filter={type: mip, variance: 0.1}",
)


@dataclass(frozen=True)
class DeviceSlot:
    """A device, or a part of a CPU, that runs one cell at a time."""

    worker: str  # name or address of the worker
    device: str  # a value for `--device`
    bits: str  # bits class
    text: str = ""  # description of the device
    cores: tuple[int, ...] = ()  # cores of the part, if several runs share a CPU; (): all cores
    memory: int = sys.maxsize  # memory available to a run, bytes


def slot_from_worker(address: str, worker: dict[str, Any]) -> DeviceSlot | None:
    """Return the device of a Dask worker, or None if the worker belongs to another program or version."""
    try:
        values = json.loads(str(worker["metrics"][METRIC_KEY]))
        if values["code"] != code_digest():
            return None
        device, bits, text = (str(values[name]) for name in ("device", "bits", "host"))
        return DeviceSlot(address, device, bits, text, memory=int(values["memory"]))
    except (ValueError, KeyError, TypeError):
        return None


def find_slots(worker: str, devices: list[str] | None = None, packing: int = 1) -> list[DeviceSlot]:
    """Return slots for the working devices of this machine, or for named devices, with their bits classes.

    packing: number of runs that share a CPU, with one slot per run.
    Raises DeviceError if no device or a named device does not work, and ConfigError if there are more runs than cores.
    """
    infos = list_devices()
    subset = [info for info in infos if not info.fault()] if devices is None else [*map(choose_device, devices)]
    if not subset:
        raise no_device_error("no OpenCL device works", "`clsplat devices` shows why")
    slots = []
    for info, core_sets in zip(subset, split_device_cores(subset, packing), strict=True):
        bits, memory = find_bits_class(info, infos), info.memory // len(core_sets)
        slot = DeviceSlot(worker, device_query(info, infos), bits, info.label, memory=memory)
        slots += [replace(slot, cores=cores) for cores in core_sets]
    return slots


def device_query(info: DeviceInfo, infos: list[DeviceInfo]) -> str:
    """Return a value for `--device` that matches only this device."""
    query = f"{info.platform} {info.name} {info.kind}"
    matches = [candidate.index for candidate in infos if candidate.matches(query)]
    return f"{query}:{matches.index(info.index)}"


def find_bits_class(info: DeviceInfo, infos: list[DeviceInfo]) -> str:
    """Return the bits class of a device; results are cached by device, driver, and program version.

    Raises DeviceError if the fixed run fails.
    """
    key = hash_values(Owner.current().host, info.label, info.driver, code_digest(), shipped_pipelines()[PIPELINE])
    cache_file = cache_folder() / "bits" / f"{key[:16]}.json"
    with suppress(DataError):
        values = read_json(cache_file)
        if isinstance(values, dict) and isinstance(values.get("bits"), str):
            return str(values["bits"])
    LOG.info("%s: running a short test to find devices that produce the same bits", info.label)
    bits = _hash_fixed_run(device_query(info, infos))
    with suppress(OutputError):
        write_text(cache_file, json.dumps({"bits": bits, "device": info.label}) + "\n")
    return bits


def _hash_fixed_run(device: str) -> str:
    with tempfile.TemporaryDirectory(prefix="clsplat-") as temp_folder:
        scene, out = Path(temp_folder, "scene"), Path(temp_folder, "run")
        settings = [argument for setting in SETTINGS for argument in ("--set", setting)]
        _run_command(device, "data", "synthetic", str(scene), *SCENE_OPTIONS)
        command = "run", str(shipped_pipelines()[PIPELINE])
        arguments = (*command, "--scene", str(scene), "--out", str(out), "--device", device)
        _run_command(device, *arguments, *settings)
        return sha256(out / "point_cloud.ply")[:CLASS_DIGITS]


def _run_command(device: str, *arguments: str) -> None:
    """Run a `clsplat` command of the fixed run.  Raises DeviceError if it fails."""
    result = run_module("clsplat", *arguments, seconds=RUN_TIMEOUT_S)
    if result.code is None:
        raise DeviceError(f"{device}: the test run did not finish within {RUN_TIMEOUT_S:.0f} s; {CHECK_DEVICE}")
    if result.code:
        lines = result.output.strip().splitlines()
        raise DeviceError(f"{device}: the test run failed ({lines[-1] if lines else result.code}); {CHECK_DEVICE}")
