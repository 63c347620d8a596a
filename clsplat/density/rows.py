"""The rows that an edit leaves: all tables rearranged, and the children of Gaussians in their places."""

from typing import Any

import numpy as np

from clsplat.density.edit import Edit
from clsplat.density.outcomes import MAX_ROWS
from clsplat.errors import MemoryLimitError
from clsplat.opencl.device import Array
from clsplat.render.tiles import Tiler


def apply_edit(edit: Edit, tiler: Tiler) -> None:
    """Rearrange all tables and place the children of split Gaussians.

    Raises MemoryLimitError where these are more rows than memory holds; all tables stay as they are.
    """
    gaussians, device, count = edit.gaussians, edit.gaussians.device, edit.gaussians.count
    program = device.program("density.cl")
    row_offset = tiler.scan(edit.copies, count, "row_offset")
    rows = int(row_offset.get_item(count))
    if rows > MAX_ROWS:
        raise MemoryLimitError(
            f"step {edit.step}: the rules ask for more than {MAX_ROWS:,} Gaussians; use densify.max_gaussians, or "
            "rules that make fewer copies"
        )
    source, fresh = device.empty(rows, np.uint32), device.empty(rows, np.uint32)
    places: dict[str, Any] = {
        "copies": edit.copies,
        "kept": edit.kept,
        "row_offset": row_offset,
        "source": source,
        "fresh": fresh,
    }
    program.list_rows(items=count, **places, count=count)
    gaussians.rearrange(source, fresh, rows)
    program.spawn_children(
        items=rows,
        source=source,
        kept=edit.kept,
        shrink=edit.shrink,
        quats=gaussians["quats"],
        means=gaussians["means"],
        log_scales=gaussians["log_scales"],
        seed=edit.seed,
        step=edit.step,
        stride=gaussians.capacity,
        count=rows,
    )
    sharing: dict[str, Any] = {"source": source, "copies": edit.copies, "shared": edit.shared}
    program.share_opacity(items=rows, **sharing, logit_opacity=gaussians["logit_opacity"], count=rows)
    if edit.children:
        _set_children(edit, row_offset)


def _set_children(edit: Edit, row_offset: Array) -> None:
    """Write what rules said of the children of some Gaussians, where these became as many rows as they said."""
    copies, first = edit.rows(), row_offset.get()
    for name, sources, values in edit.children:
        whole = copies[sources] == values.shape[1]
        rows = first[sources[whole], None] + np.arange(values.shape[1])
        edit.gaussians.set_rows(name, rows.ravel(), values[whole].reshape(-1, values.shape[2]))
