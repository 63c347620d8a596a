"""Density control: rules that say which Gaussians grow or go (Kerbl et al. 2023, section 5).

A rule gives Gaussians an outcome: how many rows each becomes.  Most rules are a box in (mean of a statistic, size,
opacity), and one kernel serves them all; others choose on the host.  Sizes are the largest standard deviation as a
share of the scene's extent.  The first growing rule whose box holds a Gaussian decides; pruning rules override growth
and judge the size that a split leaves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from clsplat.density.edit import Edit
from clsplat.gaussians.tables import Gaussians
from clsplat.render.tiles import Tiler
from clsplat.settings import Settings


class Rule(Settings):
    """A condition and the outcome of the Gaussians that meet it."""

    start: Annotated[int, Field(ge=0)] = 0
    """Global step from which, exclusive, the rule acts."""

    @property
    def statistics(self) -> set[str]:
        """Columns that the rule reads."""
        return set()

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the rule reads beside the parameters."""
        return set()

    def mark(self, edit: Edit) -> None:
        """Give outcomes by `edit.mark` or `edit.choose`; rows of tables may be changed by `edit.set_rows`."""
        raise NotImplementedError


@dataclass(frozen=True)
class Change:
    """Numbers of Gaussians before and after an edit."""

    before: int
    after: int
    causes: dict[str, int]  # Gaussians whose outcome a rule decided in the end, by the rule's name
    grown: dict[str, int]  # of these, the ones that became several


def densify(edit: Edit, rules: Sequence[Rule], tiler: Tiler, limit: int | None = None) -> Change:
    """Apply the rules in their order, as one rearrangement, and start the statistics anew.

    Growth stops at `limit` Gaussians: those with the largest screen gradient (the first column) grow first.
    """
    gaussians = edit.gaussians
    before = gaussians.count
    acting = [(number, rule) for number, rule in enumerate(rules) if edit.step > rule.start]
    decided_by = np.full(before, -1)
    for edit.rule, rule in acting:
        rows = edit.rows()
        rule.mark(edit)
        decided_by[edit.rows() != rows] = edit.rule
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
    edit.apply(tiler)
    edit.stats.clear()
    return Change(before, gaussians.count, causes, grown)


def cap_opacity(gaussians: Gaussians, limit: float) -> None:
    """Let no Gaussian stay more opaque than `limit` as it is drawn, world filter included (the opacity reset)."""
    gaussians.device.program("density.cl").cap_opacity(
        items=gaussians.count,
        log_scales=gaussians["log_scales"],
        filter_variance=gaussians["filter_variance"],
        logit_opacity=gaussians["logit_opacity"],
        limit=limit,
        stride=gaussians.capacity,
        count=gaussians.count,
    )
