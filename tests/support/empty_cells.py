"""What a cell costs beside its run: a thousand empty ones on eight workers.

python -m tests.support.empty_cells [CELLS] [WORKERS]
"""

import sys
import tempfile
import time
from pathlib import Path

import psutil

from clsplat.pipeline.execution import Execution
from clsplat.sweeps import dask
from clsplat.sweeps.cell import CellRun
from clsplat.sweeps.child import OUT
from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.engines import Dispatcher, PendingCell
from clsplat.sweeps.store import Store
from clsplat.sweeps.task import CellOptions
from tests.support.cells import SPEC


def measure(cells: int, workers: int, folder: Path) -> None:
    """Print the time a cell, the memory of the driver along the way, and the events."""
    slots = [DeviceSlot("local", f"device {number}", "b") for number in range(workers)]
    dask.find_slots = lambda worker, devices, packing: slots
    store, memory, process = Store(folder), [], psutil.Process()
    engine = dask.open_engine(Execution(engine="local"), store, None)
    engine.make_command = lambda device: ["touch", OUT]
    wanted = [PendingCell(CellRun(f"cell {i}", {**SPEC, "scene": str(i)}, ""), 1) for i in range(cells)]
    drive = Dispatcher(store, engine, True, CellOptions(store.now()))

    def ended(cell: CellRun, outcome: object) -> None:
        if len(memory) % max(1, cells // 10) == 0:
            print(f"{len(memory)} cells, driver {process.memory_info().rss >> 20} MiB")
        memory.append(process.memory_info().rss)

    drive.on_end = ended
    begin = time.perf_counter()
    drive.run(wanted)
    seconds = time.perf_counter() - begin
    engine.close()
    messages = [event["event"] for event in store.events()]
    print(f"{cells} cells on {workers} workers: {seconds:.1f} s, {1000 * seconds / cells:.1f} ms each")
    print({event: messages.count(event) for event in sorted(set(messages))})


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:]]
    with tempfile.TemporaryDirectory() as name:
        measure(*(numbers or (1000, 8)), Path(name))
