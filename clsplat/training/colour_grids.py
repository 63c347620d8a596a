"""The grids of the photographs in a run: their tables in a checkpoint, and their memory on the device."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from clsplat.errors import DataError
from clsplat.opencl.device import Device
from clsplat.scene.view import View
from clsplat.views.colours import Auto, OwnColours
from clsplat.views.grid_tables import ENTRIES, NAMES, Tables
from clsplat.views.grid_tables import GridTables as GridTables
from clsplat.views.view_colours import TABLE

FOLDER = "colour_grids/"  # before the names of their tables in a checkpoint


def check_tables(tables: Tables) -> None:
    """Raise DataError for tables that are not those of grids; there may be none, or the values alone."""
    if not tables:
        return
    if tables.keys() not in (set(NAMES), {NAMES[0]}):
        raise DataError("it has other grids than those of its own tables")
    shape = tables[NAMES[0]].shape
    for name, table in tables.items():
        is_one = table.dtype == np.float32 and table.shape == shape and len(shape) == 5 and 0 not in shape
        if not is_one or shape[1] != ENTRIES:
            raise DataError(f"{name} of its grids is not [photographs, {ENTRIES}, nz, ny, nx] of float32")
        if not np.isfinite(table).all():
            raise DataError(f"{name} of its grids holds values that are not finite")


def require_tables(tables: Tables, numbers: Mapping[str, float]) -> None:
    """Raise DataError where the rows that the numbers of a run name are not those of its grids."""
    named = sorted(row for key, row in numbers.items() if key.startswith(f"{TABLE}/") and key.endswith("/row"))
    held = len(tables[NAMES[0]]) if tables else 0
    if named != list(range(held)):
        raise DataError(f"it has grids of the colours of {held} photographs, and its numbers name {len(named)} rows")


def restored(tables: Tables, device: Device) -> GridTables | None:
    """Return the grids of a checkpoint's tables, by their own names; None without any."""
    if not tables:
        return None
    photographs, _, *cells = tables[NAMES[0]].shape
    found = GridTables(device, photographs, cells[::-1])
    found.set(tables)
    return found


def bytes_needed(settings: Any, views: Sequence[View], tile: int) -> int:
    """Return what the colours of a pipeline's trainings take on the device, at most.  tile: px of its sides."""
    kinds = [getattr(stage, "colours", None) for stage in getattr(settings, "stages", ())]
    models = [kind.model if isinstance(kind, Auto) and kind.chosen != "off" else kind for kind in kinds]
    sides = [(-(-view.camera.width // tile) * tile, -(-view.camera.height // tile) * tile) for view in views]
    rows, pixels = max(height for _, height in sides), max(width * height for width, height in sides)
    photographs = len({view.name for view in views})
    own = [one for one in models if isinstance(one, OwnColours)]
    return max((one.device_bytes(photographs, rows, pixels) for one in own), default=0)
