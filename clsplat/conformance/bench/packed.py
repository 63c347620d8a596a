"""One process of a packing: training steps on its cores, while the others of the packing have theirs.

It is started as `python -m clsplat.conformance.bench.packed WORDS`, WORDS as `Task.json`.  It prints "ready", waits
for a line, times its steps, prints them, and continues with steps until its standard input ends, so that no process is
timed on an idle machine.
"""

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from clsplat.core import machine
from clsplat.core.errors import as_clsplat_error, one_line
from clsplat.core.machine import peak_memory
from clsplat.core.signals import only_reader_of_stdin, only_writer_of_stdout
from clsplat.pipeline import plugins

READY = "ready"
Schedule = Literal["auto", "wide", "simt"]  # as in `opencl`, which is imported when the cores are chosen


@dataclass(frozen=True)
class Task:
    """What each process of a packing does."""

    place: tuple[int, int]  # of the device, platform and number
    schedule: Schedule
    cores: tuple[int, ...]  # none: those of the process that starts it
    size: tuple[int, int, int]  # of a synthetic scene: width and height, px, and Gaussians
    pipeline: str
    steps: int
    plugins: tuple[str, ...] = ()

    @classmethod
    def from_json(cls, text: str) -> "Task":
        """Return what `json` returned."""
        values: dict[str, Any] = json.loads(text)
        return cls(**values | {key: tuple(value) for key, value in values.items() if isinstance(value, list)})

    def json(self) -> str:
        """Return the task as text, for another process."""
        return json.dumps(asdict(self))


def main(task: Task) -> None:
    """Do the steps of a task, and print what they took as JSON; an error of clsplat is told so, too."""
    pipe, out = only_reader_of_stdin(), only_writer_of_stdout()
    go, ended = threading.Event(), threading.Event()

    def listen() -> None:
        while os.read(pipe, 1024):
            go.set()
        ended.set()
        go.set()

    threading.Thread(target=listen, daemon=True).start()

    def told(**values: object) -> None:
        out.write(json.dumps(values) + "\n")
        out.flush()

    try:
        machine.keep_to(task.cores or machine.usable())  # before a runtime starts its threads
        step = _steps(task)
        told(state=READY)
        go.wait()
        started = time.perf_counter()
        for _ in range(task.steps):
            if ended.is_set():
                return
            step()
        told(seconds=time.perf_counter() - started, memory=peak_memory())
        while not ended.is_set():
            step()
    except Exception as error:
        known = as_clsplat_error(error)
        told(error=one_line(known), exit_code=known.exit_code)
        ended.wait()


def _steps(task: Task) -> Callable[[], None]:
    """What does one step, compiled and warm."""
    from clsplat.conformance.bench.cases import case
    from clsplat.opencl.device import Device
    from clsplat.opencl.discovery import list_devices
    from clsplat.pipeline.loading import load

    for file in task.plugins:
        plugins.load_file(Path(file))
    info = next(info for info in list_devices() if info.place == task.place)
    timed = case(Device(info, task.schedule), *task.size, load(task.pipeline).settings)
    return lambda: timed.step(record=False)


if __name__ == "__main__":
    main(Task.from_json(sys.argv[1]))
