"""How far the cells of a sweep are: a line of the log now and then, a bar in the terminal."""

import time
from collections.abc import Mapping

from clsplat.cluster.cell import Cell
from clsplat.cluster.store import Store
from clsplat.progress import Count
from clsplat.training.status import read_status

EVERY = 2.0  # seconds between two looks at the files
SHOWN = 4  # cells that are named


class Watched:
    """Counts the steps of all cells, from the files of those that run."""

    def __init__(self, steps: Mapping[str, int]) -> None:
        """steps: of each cell, by its name."""
        self._steps, self._looked = steps, time.monotonic()
        self._count = Count("steps", sum(steps.values()))

    def __call__(self, store: Store, running: Mapping[str, Cell], ended: Mapping[str, object]) -> None:
        """Look, where it is time to."""
        if time.monotonic() - self._looked < EVERY:
            return
        self._looked = time.monotonic()
        done = sum(self._steps.get(name, 0) for name in ended)
        told = []
        for name, cell in running.items():
            newest = max(store.folder(cell.key).attempts(), key=lambda attempt: attempt.beaten, default=None)
            step = read_status(newest.path).get("step") if newest else 0
            if isinstance(step, int):
                done += step
                told.append(f"{name} {step}/{self._steps.get(name, 0)}")
        named = ", ".join([*told[:SHOWN], *(["…"] if len(told) > SHOWN else [])])
        self._count.what = f"steps ({named})" if told else "steps"
        self._count.reach(min(done, self._count.total))
