"""Apply density rules, as one edit; reset or lower opacities (Kerbl et al. 2023, section 5); move means at random."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from clsplat.density.box import Box
from clsplat.density.edit import Edit, Rule
from clsplat.density.rows import apply_edit
from clsplat.gaussians.tables import Gaussians
from clsplat.render.tiles import Tiler


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


def decay_opacity(gaussians: Gaussians, factor: float) -> None:
    """Multiply all opacities by a factor in (0, 1)."""
    gaussians.device.program("density.cl").decay_opacity(
        items=gaussians.count,
        logit_opacity=gaussians["logit_opacity"],
        fall=1 - factor,
        count=gaussians.count,
    )


def add_noise(gaussians: Gaussians, rate: float, opacity_below: float, seed: int, step: int) -> None:
    """Move each mean by rate / (1 + exp(-100 (opacity_below - opacity))) Σ n, n three normal numbers (Kheradmand et
    al. 2024).  rate: scene units⁻¹.
    """
    gaussians.device.program("noise.cl").add_noise(
        items=gaussians.count,
        means=gaussians["means"],
        quats=gaussians["quats"],
        log_scales=gaussians["log_scales"],
        logit_opacity=gaussians["logit_opacity"],
        rate=rate,
        opacity_below=opacity_below,
        seed=seed,
        step=step,
        stride=gaussians.capacity,
        count=gaussians.count,
    )
