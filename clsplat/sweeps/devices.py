"""The bits class of a device: the hash of what a fixed run gives on it.

A name is not enough, and too much: other runtimes may give the same bits, and the same runtime others on another
processor.  Devices of one class may go on with each other's cells.
"""

import json
import logging
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.core import machine
from clsplat.core.errors import ConfigError, DataError, DeviceError, OutputError, pluralize
from clsplat.core.files import write_text
from clsplat.core.machine import Owner, cache_folder
from clsplat.core.manifest import hash_values
from clsplat.core.reading import read_file, read_json, sha256
from clsplat.opencl.discovery import DeviceInfo, choose, list_devices
from clsplat.pipeline.files import shipped
from clsplat.sweeps.cell import code_digest
from clsplat.sweeps.child import filled, run_command

# How many runs share a CPU, and which cores each has.

LOG = logging.getLogger("clsplat")
Parts = list[tuple[int, ...]]  # the cores of each run; one without cores has all, and is not kept to any


def shares_of(devices: Sequence[DeviceInfo], packing: int) -> list[Parts]:
    """Return the cores of the runs of each device; a device that is no CPU has one run.

    Raises ConfigError for more runs than cores.
    """
    own = machine.usable_cores()
    if packing > len(own):
        raise ConfigError(
            f"execution.packing: {packing} runs cannot share {pluralize(len(own), 'core')}; expected fewer"
        )
    parts: Parts = machine.split_cores(own, packing) if packing > 1 else [()]
    return [parts if info.kind == "CPU" else [()] for info in devices]


TOLD = "clsplat"  # name of what a worker tells of its device, among the figures that Dask keeps of it
CLASS = 8  # hexadecimal digits of a bits class
SECONDS = 600.0  # that the fixed run may take: a runtime may build its kernels for minutes
SCENE_OPTIONS = ("--size", "48", "--train", "8", "--test", "2", "--seed", "0")
PIPELINE = "smoke"  # it grows, and resets opacity; with all bands, and both filters:
SETTINGS = (
    "model.sh_degree=3",
    "model.world_filter={type: smoothing, variance: 0.2}",
    "model.screen_filter={type: mip, variance: 0.1}",
)


@dataclass(frozen=True)
class DeviceSlot:
    """A device that runs cells, one at a time."""

    worker: str  # who offers it
    device: str  # as `--device` takes it
    bits: str  # its class
    text: str = ""  # what it is
    cores: tuple[int, ...] = ()  # of a CPU that several runs share; none: all
    memory: int = sys.maxsize  # bytes that a run may take


def place_of(address: str, worker: dict[str, Any]) -> DeviceSlot | None:
    """Return the device that a worker tells; None for a worker of another program, or version."""
    try:
        values = json.loads(str(worker["metrics"][TOLD]))
        if values["code"] != code_digest():
            return None
        device, bits, text = (str(values[name]) for name in ("device", "bits", "host"))
        return DeviceSlot(address, device, bits, text, memory=int(values["memory"]))
    except (ValueError, KeyError, TypeError):
        return None


def places(worker: str, devices: list[str] | None = None, packing: int = 1) -> list[DeviceSlot]:
    """Return the devices of this machine that work, or those of a list of names, with their classes.

    packing: the runs that share a CPU, each of which has a place.
    Raises DeviceError where there is none, or one of the list does not work, ConfigError for more runs than cores.
    """
    infos = list_devices()
    chosen = [choose(name) for name in devices] if devices is not None else [one for one in infos if not one.fault()]
    if not chosen:
        raise DeviceError("no OpenCL device works; `clsplat devices` tells why")
    found = []
    for info, parts in zip(chosen, shares_of(chosen, packing), strict=True):
        bits, memory = bits_class(info, infos), info.memory // len(parts)
        own = DeviceSlot(worker, word_of(info, infos), bits, info.text, memory=memory)
        found += [replace(own, cores=part) for part in parts]
    return found


def word_of(info: DeviceInfo, infos: list[DeviceInfo]) -> str:
    """Return the words that name one device of several for `--device`."""
    words = f"{info.platform} {info.name} {info.kind}"
    same = [one.index for one in infos if one.matches(words)]
    return f"{words}:{same.index(info.index)}"


def bits_class(info: DeviceInfo, infos: list[DeviceInfo]) -> str:
    """Return the class of a device; the fixed run is run once for a device, its driver and the program.

    Raises DeviceError where it fails.
    """
    key = hash_values(Owner.current().host, info.text, info.driver, code_digest(), shipped()[PIPELINE])
    note = cache_folder() / "bits" / f"{key[:16]}.json"
    with suppress(DataError):
        found = read_json(note)
        if isinstance(found, dict) and isinstance(found.get("bits"), str):
            return str(found["bits"])
    LOG.info("%s: a short run tells which devices give the same bits", info.text)
    bits = _run(word_of(info, infos))
    with suppress(OutputError):
        write_text(note, json.dumps({"bits": bits, "device": info.text}) + "\n")
    return bits


def _run(device: str) -> str:
    with tempfile.TemporaryDirectory(prefix="clsplat-") as name:
        folder = Path(name)
        scene = str(folder / "scene")
        _call(device, [sys.executable, "-P", "-m", "clsplat", "data", "synthetic", scene, *SCENE_OPTIONS], folder)
        words = filled(run_command(device), shipped()[PIPELINE], folder / "run")
        _call(device, [*words, "--scene", scene, *(word for one in SETTINGS for word in ("--set", one))], folder)
        return sha256(folder / "run" / "point_cloud.ply")[:CLASS]


def _call(device: str, command: list[str], folder: Path) -> None:
    """Run a command of the test, whose input stays open.  Raises DeviceError where it fails."""
    with (folder / "errors.txt").open("wb") as errors:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors)
        try:
            process.wait(SECONDS)
        except subprocess.TimeoutExpired:
            raise DeviceError(f"{device}: the run of its test did not end in {SECONDS:.0f} s") from None
        finally:
            process.kill()
            process.wait()
            assert process.stdin
            process.stdin.close()
    if process.returncode:
        lines = read_file(folder / "errors.txt").decode(errors="replace").strip().splitlines()
        raise DeviceError(f"{device}: the run of its test failed: {lines[-1] if lines else process.returncode}")
