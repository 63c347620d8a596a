"""Find devices and their bits classes: a class is the hash of the result of a fixed run.

Names of devices are not enough: different runtimes may give the same bits, and one runtime may give different bits on
another processor.  Devices of one class can continue each other's cells.
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
from clsplat.opencl.discovery import DeviceInfo, choose, list_devices
from clsplat.opencl.runtimes import no_device_error
from clsplat.pipeline.files import shipped_pipelines
from clsplat.sweeps.cell import code_digest

LOG = logging.getLogger("clsplat")
Parts = list[tuple[int, ...]]  # the cores of each run; (): all cores, not pinned


def split_device_cores(devices: Sequence[DeviceInfo], packing: int) -> list[Parts]:
    """Return the cores of the runs of each device: `packing` runs on a CPU, one on other devices.

    Raises ConfigError if there are more runs than cores.
    """
    cores = machine.usable_cores()
    if packing > len(cores):
        raise ConfigError(
            f"execution.packing: {packing} runs cannot share {pluralize(len(cores), 'core')}; set at most {len(cores)}"
        )
    parts: Parts = machine.split_cores(cores, packing) if packing > 1 else [()]
    return [parts if info.kind == "CPU" else [()] for info in devices]


METRIC_KEY = "clsplat"  # of the Dask metric in which a worker describes its device
CLASS_DIGITS = 8  # hexadecimal digits of a bits class
RUN_TIMEOUT_S = 600.0  # for the fixed run; some runtimes take minutes to build kernels
SCENE_OPTIONS = ("--size", "48", "--train", "8", "--test", "2", "--seed", "0")
PIPELINE = "smoke"  # has growth and opacity resets; the settings add all SH bands and both filters
SETTINGS = (
    "model.sh_degree=3",
    "model.world_filter={type: smoothing, variance: 0.2}",
    "model.screen_filter={type: mip, variance: 0.1}",
)


@dataclass(frozen=True)
class DeviceSlot:
    """A device, or a part of a CPU, that runs one cell at a time."""

    worker: str  # name or address of its worker
    device: str  # a value for `--device`
    bits: str  # bits class
    text: str = ""  # description
    cores: tuple[int, ...] = ()  # if several runs share a CPU; (): all cores
    memory: int = sys.maxsize  # available to a run, bytes


def slot_from_worker(address: str, worker: dict[str, Any]) -> DeviceSlot | None:
    """Return the device that a Dask worker describes, or None for a worker of another program or version."""
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

    packing: number of runs that share a CPU; each gets a slot.
    Raises DeviceError if no device works, or a named one does not, and ConfigError for more runs than cores.
    """
    infos = list_devices()
    chosen = [choose(name) for name in devices] if devices is not None else [info for info in infos if not info.fault()]
    if not chosen:
        raise no_device_error("no OpenCL device works", "`clsplat devices` shows why")
    slots = []
    for info, parts in zip(chosen, split_device_cores(chosen, packing), strict=True):
        bits, memory = bits_class(info, infos), info.memory // len(parts)
        slot = DeviceSlot(worker, device_query(info, infos), bits, info.text, memory=memory)
        slots += [replace(slot, cores=part) for part in parts]
    return slots


def device_query(info: DeviceInfo, infos: list[DeviceInfo]) -> str:
    """Return a value for `--device` that matches only this device."""
    words = f"{info.platform} {info.name} {info.kind}"
    matches = [other.index for other in infos if other.matches(words)]
    return f"{words}:{matches.index(info.index)}"


def bits_class(info: DeviceInfo, infos: list[DeviceInfo]) -> str:
    """Return the bits class of a device; the result is cached by device, driver, and program version.

    Raises DeviceError if the run fails.
    """
    key = hash_values(Owner.current().host, info.text, info.driver, code_digest(), shipped_pipelines()[PIPELINE])
    cache_file = cache_folder() / "bits" / f"{key[:16]}.json"
    with suppress(DataError):
        values = read_json(cache_file)
        if isinstance(values, dict) and isinstance(values.get("bits"), str):
            return str(values["bits"])
    LOG.info("%s: running a short test to find devices that give the same bits", info.text)
    bits = _hash_fixed_run(device_query(info, infos))
    with suppress(OutputError):
        write_text(cache_file, json.dumps({"bits": bits, "device": info.text}) + "\n")
    return bits


def _hash_fixed_run(device: str) -> str:
    with tempfile.TemporaryDirectory(prefix="clsplat-") as name:
        scene, out = Path(name, "scene"), Path(name, "run")
        settings = [word for setting in SETTINGS for word in ("--set", setting)]
        _run_command(device, "data", "synthetic", str(scene), *SCENE_OPTIONS)
        run = "run", str(shipped_pipelines()[PIPELINE])
        words = (*run, "--scene", str(scene), "--out", str(out), "--device", device)
        _run_command(device, *words, *settings)
        return sha256(out / "point_cloud.ply")[:CLASS_DIGITS]


def _run_command(device: str, *words: str) -> None:
    """Run a command of the test.  Raises DeviceError if it fails."""
    result = run_module("clsplat", *words, seconds=RUN_TIMEOUT_S)
    if result.code is None:
        raise DeviceError(f"{device}: the test run did not end within {RUN_TIMEOUT_S:.0f} s")
    if result.code:
        lines = result.output.strip().splitlines()
        raise DeviceError(f"{device}: the test run failed: {lines[-1] if lines else result.code}")
