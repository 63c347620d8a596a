"""Apply density rules as one edit, and reset opacities (Kerbl et al. 2023, section 5)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from clsplat.core.errors import MemoryLimitError
from clsplat.core.settings import Settings
from clsplat.density.edit import MAX_ROWS, Edit, Rule
from clsplat.gaussians.gaussians import Gaussians
from clsplat.opencl.device import Array
from clsplat.render.tiles import Tiler


def apply_edit(edit: Edit, tiler: Tiler) -> None:
    """Rearrange all tables, and sample positions for the children of split Gaussians.

    Raises MemoryLimitError, before any change, if there would be more than MAX_ROWS rows.
    """
    gaussians, device, count = edit.gaussians, edit.gaussians.device, edit.gaussians.count
    program = device.program("density.cl")
    row_offset = tiler.scan(edit.copies, count, "row_offset")
    rows = int(row_offset.get_item(count))
    if rows > MAX_ROWS:
        raise MemoryLimitError(
            f"step {edit.step}: the rules would create more than {MAX_ROWS:,} Gaussians; set densify.max_gaussians, or "
            "use rules that create fewer copies"
        )
    source, fresh = device.empty(rows, np.uint32), device.empty(rows, np.uint32)
    program.list_rows(
        items=count,
        copies=edit.copies,
        old_rows=edit.old_rows,
        row_offset=row_offset,
        source=source,
        fresh=fresh,
        count=count,
    )
    gaussians.rearrange(source, fresh, rows)
    program.spawn_children(
        items=rows,
        source=source,
        old_rows=edit.old_rows,
        shrink=edit.shrink,
        quats=gaussians["quats"],
        means=gaussians["means"],
        log_scales=gaussians["log_scales"],
        seed=edit.seed,
        step=edit.step,
        stride=gaussians.capacity,
        count=rows,
    )
    program.share_opacity(
        items=rows,
        source=source,
        copies=edit.copies,
        shared=edit.shared,
        logit_opacity=gaussians["logit_opacity"],
        count=rows,
    )
    if edit.children:
        _set_children(edit, row_offset)


def _set_children(edit: Edit, row_offset: Array) -> None:
    """Write the values that rules set for children, unless a later rule or limit changed the number of children."""
    copies, first_rows = edit.row_counts(), row_offset.get()
    for name, sources, values in edit.children:
        keeps_count = copies[sources] == values.shape[1]
        rows = first_rows[sources[keeps_count], None] + np.arange(values.shape[1])
        edit.gaussians.set_rows(name, rows.ravel(), values[keeps_count].reshape(-1, values.shape[2]))


Corner = Annotated[list[float | None], Field(min_length=3, max_length=3)]


class Box(Settings):
    """An axis-aligned box; it includes only its lower faces, so adjacent boxes share no points."""

    low: Corner = Field(default=[None, None, None])
    """Smallest x, y, and z, in the dataset's coordinates, inclusive; null: no bound."""
    high: Corner = Field(default=[None, None, None])
    """Largest x, y, and z, in the dataset's coordinates, exclusive; null: no bound."""

    @model_validator(mode="after")
    def _require_volume(self) -> "Box":
        for name, low, high in zip("xyz", self.low, self.high, strict=True):
            if low is not None and high is not None and not low < high:
                raise ValueError(f"expected 'low' below 'high' on each axis, got {low:g} and {high:g} for {name}")
        return self

    def shifted(self, origin: NDArray[np.floating]) -> "Box":
        """Return the box in coordinates relative to `origin`, [3]."""
        if not origin.any():
            return self
        low, high = (
            [None if value is None else float(value - offset) for value, offset in zip(corner, origin, strict=True)]
            for corner in (self.low, self.high)
        )
        return self.model_copy(update={"low": low, "high": high})

    def contains(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return a mask, [N], of the points inside the box.  points: [N, 3]; points with NaN are outside."""
        is_inside = ~np.isnan(points).any(axis=1)
        for axis, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            values = points[:, axis].astype(np.float64)
            is_inside &= (True if low is None else values >= low) & (True if high is None else values < high)
        return np.asarray(is_inside)


@dataclass(frozen=True)
class Change:
    """The number of Gaussians before and after an edit."""

    before: int
    after: int
    causes: dict[str, int]  # number of Gaussians with an outcome set by a rule, by the rule's name
    grown: dict[str, int]  # like causes, but only Gaussians that became several


def densify(
    edit: Edit,
    rules: Sequence[Rule],
    tiler: Tiler,
    limit: int | None = None,
    inside: Box | None = None,
    make_room: Callable[[int], None] = lambda count: None,
) -> Change:
    """Apply the rules, in order, as one rearrangement of all tables; then set the statistics to zero.

    limit, inside: as for `mark`.  make_room: a function that is called with the new number of Gaussians before the
    tables grow.
    """
    change = mark(edit, rules, limit, inside)
    make_room(change.after)
    apply_edit(edit, tiler)
    edit.stats.clear()
    return change


def mark(edit: Edit, rules: Sequence[Rule], limit: int | None = None, inside: Box | None = None) -> Change:
    """Let the rules mark an edit, in order, and return the change that it will make.

    limit: the number of Gaussians at which growth stops; Gaussians with the largest mean of the first statistic grow
    first.  inside: the region in which Gaussians may grow; None for everywhere.
    """
    edit.max_rows = limit
    gaussians = edit.gaussians
    old_count = gaussians.count
    active_rules = [(index, rule) for index, rule in enumerate(rules) if edit.step > rule.start]
    rule_index = np.full(old_count, -1)
    for edit.rule, rule in active_rules:
        rows = edit.row_counts()
        rule.mark(edit)
        rule_index[edit.row_counts() != rows] = edit.rule
    if inside is not None:
        edit.undo_growth(~inside.contains(gaussians.get("means")))
    if limit is not None and int(edit.row_counts().sum(dtype=np.int64)) > limit:
        edit.limit(limit)
    rows = edit.row_counts()
    rule_index[rows == 1] = -1
    causes: dict[str, int] = {}
    growth_counts: dict[str, int] = {}
    for index, rule in active_rules:
        name = getattr(rule, "type", "rule")
        causes[name] = causes.get(name, 0) + int((rule_index == index).sum())
        growth_counts[name] = growth_counts.get(name, 0) + int(((rule_index == index) & (rows > 1)).sum())
    return Change(old_count, int(rows.sum(dtype=np.int64)), causes, growth_counts)


def cap_opacity(gaussians: Gaussians, limit: float) -> None:
    """Lower opacities so that they are at most `limit` after the 3D filter (the opacity reset)."""
    gaussians.device.program("density.cl").cap_opacity(
        items=gaussians.count,
        log_scales=gaussians["log_scales"],
        filter_variance=gaussians["filter_variance"],
        logit_opacity=gaussians["logit_opacity"],
        limit=limit,
        stride=gaussians.capacity,
        count=gaussians.count,
    )


def keep_rows(gaussians: Gaussians, rows: NDArray[np.int64], cause: str) -> Change:
    """Remove all Gaussians except `rows`, [n], in ascending order.  cause: the key in `Change.causes`."""
    old_count = gaussians.count
    source = gaussians.device.upload(rows.astype(np.uint32))
    gaussians.rearrange(source, gaussians.device.zeros(len(rows), np.uint32), len(rows))
    return Change(old_count, len(rows), {cause: old_count - len(rows)}, {})
