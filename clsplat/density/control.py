"""Apply density rules, as one edit; reset opacities (Kerbl et al. 2023, section 5)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from clsplat.core.errors import MemoryLimitError
from clsplat.core.settings import Settings
from clsplat.density.edit import MAX_ROWS, Edit, Rule
from clsplat.gaussians.gaussians import Gaussians
from clsplat.opencl.device import Array
from clsplat.render.tiles import Tiler

# The rows that an edit leaves: all tables rearranged, and the children of Gaussians in their places.


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


# A part of space, such as the one in which Gaussians grow.

Corner = Annotated[list[float | None], Field(min_length=3, max_length=3)]


class Box(Settings):
    """A box with its lower faces and without its upper ones, so that boxes side by side share no point."""

    low: Corner = Field(default=[None, None, None])
    """Lowest x, y and z, scene units; null: none."""
    high: Corner = Field(default=[None, None, None])
    """First x, y and z beyond it, scene units; null: none."""

    @model_validator(mode="after")
    def _with_room(self) -> "Box":
        for name, low, high in zip("xyz", self.low, self.high, strict=True):
            if low is not None and high is not None and not low < high:
                raise ValueError(f"expected 'low' below 'high' on each axis, got {low:g} and {high:g} for {name}")
        return self

    def holds(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return which points, [N, 3] scene units, lie in it, [N]; one that is not a number lies nowhere."""
        found = ~np.isnan(points).any(axis=1)
        for axis, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            values = points[:, axis].astype(np.float64)
            found &= (True if low is None else values >= low) & (True if high is None else values < high)
        return np.asarray(found)


@dataclass(frozen=True)
class Change:
    """Numbers of Gaussians before and after an edit."""

    before: int
    after: int
    causes: dict[str, int]  # Gaussians whose final outcome a rule decided, by the rule's name
    grown: dict[str, int]  # of these, the ones that became several


def densify(
    edit: Edit,
    rules: Sequence[Rule],
    tiler: Tiler,
    limit: int | None = None,
    inside: Box | None = None,
    make_room: Callable[[int], None] = lambda count: None,
) -> Change:
    """Apply the rules in their order, as one rearrangement of all tables, and set the statistics to zero.

    limit, inside: as for `mark`.  make_room: is told how many there will be, before any is added.
    """
    change = mark(edit, rules, limit, inside)
    make_room(change.after)
    apply_marks(edit, tiler)
    return change


def apply_marks(edit: Edit, tiler: Tiler) -> None:
    """Rearrange all tables as an edit was marked, and set the statistics to zero."""
    apply_edit(edit, tiler)
    edit.stats.clear()


def mark(edit: Edit, rules: Sequence[Rule], limit: int | None = None, inside: Box | None = None) -> Change:
    """Let the rules mark an edit, in their order; return what it will change.

    inside: the part of space in which Gaussians grow.  Growth stops at `limit` Gaussians: those with the largest mean
    of the first column grow first.  Rules read in `edit.room` how many they may add.
    """
    edit.max_rows = limit
    gaussians = edit.gaussians
    before = gaussians.count
    acting = [(number, rule) for number, rule in enumerate(rules) if edit.step > rule.start]
    decided_by = np.full(before, -1)
    for edit.rule, rule in acting:
        rows = edit.rows()
        rule.mark(edit)
        decided_by[edit.rows() != rows] = edit.rule
    if inside is not None:
        edit.undo_growth(~inside.holds(gaussians.get("means")))
    if limit is not None and int(edit.rows().sum(dtype=np.int64)) > limit:
        edit.limit(limit)
    rows = edit.rows()
    decided_by[rows == 1] = -1
    causes: dict[str, int] = {}
    grown: dict[str, int] = {}
    for number, rule in acting:
        name = getattr(rule, "type", "rule")
        causes[name] = causes.get(name, 0) + int((decided_by == number).sum())
        grown[name] = grown.get(name, 0) + int(((decided_by == number) & (rows > 1)).sum())
    return Change(before, int(rows.sum(dtype=np.int64)), causes, grown)


def cap_opacity(gaussians: Gaussians, limit: float) -> None:
    """Lower opacities to `limit`, which holds for the opacity after the world filter (the opacity reset)."""
    gaussians.device.program("density.cl").cap_opacity(
        items=gaussians.count,
        log_scales=gaussians["log_scales"],
        filter_variance=gaussians["filter_variance"],
        logit_opacity=gaussians["logit_opacity"],
        limit=limit,
        stride=gaussians.capacity,
        count=gaussians.count,
    )


def keep(gaussians: Gaussians, kept: NDArray[np.int64], cause: str) -> Change:
    """Remove all Gaussians but those in some rows, ascending.  cause: a name of what chose them."""
    before = gaussians.count
    source = gaussians.device.upload(kept.astype(np.uint32))
    gaussians.rearrange(source, gaussians.device.zeros(len(kept), np.uint32), len(kept))
    return Change(before, len(kept), {cause: before - len(kept)}, {})
