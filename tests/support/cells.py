"""Cells of a sweep, and an engine whose cells end as specified."""

import os
from pathlib import Path

from clsplat.pipeline.loading import load
from clsplat.sweeps.cell import CellRun, Scenes
from clsplat.sweeps.child import FILE, OUT, PYTHON
from clsplat.sweeps.devices import DeviceSlot
from clsplat.sweeps.engines import CellLost, PendingCell
from clsplat.sweeps.task import Outcome

KILLS = int(os.environ.get("CLSPLAT_KILLS", "0"))


SPEC = {"pipeline": {"name": "a", "seed": 0}, "scene": "s", "code": "c", "bits": "b"}


CELL = CellRun("first", SPEC, "name: a\n")


WRITES = "import sys, pathlib; pathlib.Path(sys.argv[2], 'point_cloud.ply').write_bytes(b'bits')"


def command(code: str) -> list[str]:
    """A command instead of a run: it gets the pipeline file and the run folder."""
    return [PYTHON, "-S", "-c", code, FILE, OUT]


def keys(pipeline: str, scene: Path, folder: Path, *changes: str) -> str:
    checked = load(pipeline, [f"scene.path={scene}", *changes])
    return CellRun.from_pipeline("x", checked, Scenes(folder).facts(checked).digest, "b").key


class Fake:
    """An engine whose cells end as they were told to; a Lost is raised."""

    def __init__(
        self, *ends: Outcome | type[CellLost], slots: tuple[DeviceSlot, ...] = (DeviceSlot("w", "d", "b"),)
    ) -> None:
        self.ends, self._slots, self.started = list(ends), slots, []

    def slots(self):
        return list(self._slots)

    def start(self, cell, slot, options):
        self.started.append((cell.name, slot.device, cell.spec["bits"]))
        end = self.ends.pop(0)

        class Ticket:
            def outcome(self):
                if end is CellLost:
                    raise CellLost
                return end

        return Ticket()


def pending_cells(*costs: float) -> list[PendingCell]:
    return [PendingCell(CellRun(f"{cost:g}", {**SPEC, "scene": str(cost)}, ""), cost) for cost in costs]
