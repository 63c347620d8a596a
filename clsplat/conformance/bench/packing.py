"""How many runs at once a CPU trains fastest: processes that share its cores, timed together.

One run on many cores waits for its threads at every kernel, and for work that the host does alone; several runs, each
on cores of its own, do not wait for each other.  Bits do not depend on it.
"""

import hashlib
import json
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from clsplat.conformance.bench.packed import READY, Schedule, Task
from clsplat.core import machine
from clsplat.core.errors import ConfigError, DataError, DeviceError, MemoryLimitError, OutputError
from clsplat.core.files import write_text
from clsplat.core.machine import cache_folder
from clsplat.core.reading import read_json
from clsplat.core.text_table import text_table
from clsplat.opencl.discovery import DeviceInfo
from clsplat.pipeline import plugins

MODULE = "clsplat.conformance.bench.packed"
CLOSE = 0.97  # of the best rate: a packing of fewer processes, which need less memory, is taken before one of more
FOLDER = "packing"  # of the caches


@dataclass(frozen=True)
class Packing:
    """What a number of processes does together."""

    processes: int
    cores: int  # of each
    rate: float  # steps per second, of all
    memory: int | None  # bytes of the largest process at its peak; None where the system does not say


@dataclass(frozen=True)
class Packings:
    """All packings of a device that were tried."""

    device: str
    scene: str
    pipeline: str
    tried: list[Packing]
    refused: dict[int, str]  # why a number of processes could not be timed

    @property
    def best(self) -> int:
        """The fewest processes whose rate is close to the best."""
        fastest = max(one.rate for one in self.tried)
        return min(one.processes for one in self.tried if one.rate >= CLOSE * fastest)

    def data(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {**asdict(self), "best": self.best}

    def text(self) -> str:
        """Return a table."""
        rows = [("processes", "cores each", "steps/s, all", "MiB each")]
        for one in self.tried:
            memory = "" if one.memory is None else f"{one.memory / 2**20:,.0f}"
            rows.append((str(one.processes), str(one.cores), f"{one.rate:.1f}", memory))
        lines = [f"device: {self.device}", f"scene {self.scene}, {self.pipeline}", text_table(rows)]
        lines += [f"{number} processes: {why}" for number, why in self.refused.items()]
        lines.append(f"best: {told(self.best)}; sweeps with engine local take it (packing: auto)")
        return "\n".join(lines)


def told(processes: int) -> str:
    """Return a packing in words."""
    return "one run at a time" if processes == 1 else f"{processes} runs at a time"


def measure_packings(info: DeviceInfo, task: Task, scene: str = "", numbers: Sequence[int] | None = None) -> Packings:
    """Time the packings of a CPU, and note the best for sweeps.

    task: what each process does, for any cores; scene: its name; numbers: of processes; default: all that fit.
    Raises ConfigError for a device that is no CPU, and MemoryLimitError where no packing fits.
    """
    if info.kind != "CPU":
        raise ConfigError(f"--packing: {info.text} is no CPU, whose cores could be shared; choose one by --device")
    own, tried, refused = machine.usable(), [], {}
    for number in numbers or machine.packings(len(own)):
        try:
            tried.append(_together(task, machine.shares(own, number)))
        except MemoryLimitError as error:
            refused[number] = str(error)
    if not tried:
        raise MemoryLimitError("; ".join(refused.values()))
    found = Packings(info.text, scene, task.pipeline, tried, refused)
    with suppress(OutputError):
        write_text(_record(info), json.dumps(found.data()) + "\n")
    return found


def known_packing(info: DeviceInfo) -> int | None:
    """Return the best packing of a device as `measure_packings` noted it; None where it was not measured here.

    What was found with other cores does not count.
    """
    with suppress(DataError):
        found = read_json(_record(info))
        best = found.get("best") if isinstance(found, dict) else None
        return best if type(best) is int and 1 <= best <= len(machine.usable()) else None
    return None


def task_of(info: DeviceInfo, size: tuple[int, int, int], pipeline: str, steps: int, schedule: Schedule) -> Task:
    """Return what the processes of a packing do, with the plug-ins of this one."""
    files = tuple(str(plugin.path) for plugin in plugins.loaded() if not plugin.installed)
    return Task(info.place, schedule, (), size, pipeline, steps, files)


def _record(info: DeviceInfo) -> Path:
    decisive = json.dumps([info.platform, info.name, info.driver, len(machine.usable())])
    return cache_folder() / FOLDER / f"{hashlib.sha256(decisive.encode()).hexdigest()[:16]}.json"


def _together(task: Task, parts: list[tuple[int, ...]]) -> Packing:
    """Time processes, one for each part of the cores, all at once."""
    with ExitStack() as held:
        processes = [held.enter_context(_process(task, part)) for part in parts]
        for process in processes:  # all are warm before any is timed
            _answer(process)
        for process in processes:
            _say(process, "go\n")
        answers = [_answer(process) for process in processes]
    rate = sum(task.steps / answer["seconds"] for answer in answers)
    memory = [answer["memory"] for answer in answers if answer["memory"] is not None]
    return Packing(len(parts), len(parts[0]), rate, max(memory, default=None))


@contextmanager
def _process(task: Task, part: tuple[int, ...]) -> Iterator["subprocess.Popen[str]"]:
    own = Task(**{**asdict(task), "cores": part})
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", MODULE, own.json()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        encoding="utf-8",
        env=machine.limited(part),
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):
                pipe.close()  # type: ignore[union-attr]


def _say(process: "subprocess.Popen[str]", text: str) -> None:
    assert process.stdin
    with suppress(OSError):  # it has ended, which its answer tells
        process.stdin.write(text)
        process.stdin.flush()


def _answer(process: "subprocess.Popen[str]") -> dict[str, Any]:
    """Return what a process tells next.  Raises MemoryLimitError, or DeviceError with what it says."""
    assert process.stdout
    line = process.stdout.readline()
    try:
        found: dict[str, Any] = json.loads(line)
    except ValueError:
        raise DeviceError(f"a process of the packing ended with code {process.wait()}, and no answer") from None
    if "error" in found:
        error = MemoryLimitError if found["exit_code"] == MemoryLimitError.exit_code else DeviceError
        raise error(str(found["error"]))
    assert found.get("state", READY) == READY
    return found
