"""Density control: rules that say which Gaussians grow or go (Kerbl et al. 2023, section 5).

A rule is a box in (mean of a statistic, size, opacity) with an outcome; one kernel serves them all.  Sizes are the
largest standard deviation as a share of the scene's extent.  Growing rules take a Gaussian in their order, the first
that wants it; pruning rules override growth and judge the size that a split leaves.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.thresholds import PixelQuantile, Quantile, Threshold
from clsplat.errors import ConfigError
from clsplat.gaussians.tables import Gaussians
from clsplat.render.tiles import Tiler
from clsplat.settings import Settings

Positive = Annotated[float, Field(gt=0)]
MAX_BOUND = 3.0e38  # a bound that no finite float passes
MIN_BOUND = 1.2e-38  # the smallest normal float: a bound that only zero misses


def _no_photographs(share: float) -> float:
    raise ConfigError("a quantile of pixels needs training photographs")


@dataclass(frozen=True)
class SceneScale:
    """What rules measure Gaussians by: the scene's extent in scene units, and the texture of its photographs."""

    extent: float
    texture_quantile: Callable[[float], float] = _no_photographs


class Edit:
    """What will become of each Gaussian: how many rows, how many of them the old one, by what fresh scales shrink."""

    def __init__(self, gaussians: Gaussians, stats: SplatStats, measures: SceneScale, step: int) -> None:
        device, count = gaussians.device, gaussians.count
        self.gaussians, self.stats, self.measures, self.step = gaussians, stats, measures, step
        self.copies = device.empty(count, np.uint32)
        self.kept = device.empty(count, np.uint32)
        self.shrink = device.empty(count)
        self._program = device.program("density.cl")
        self._program.start_edit(items=count, copies=self.copies, kept=self.kept, shrink=self.shrink, count=count)

    def mark(
        self,
        copies: int,
        kept: int,
        shrink: float = 1.0,
        statistic: str | None = None,
        gradient_above: float = 0.0,
        size_above: float = 0.0,
        size_below: float | None = None,
        opacity_below: float = math.inf,
    ) -> None:
        """Give every Gaussian in the box its outcome; sizes are shares of the extent."""
        gaussians = self.gaussians
        self._program.mark_rule(
            items=gaussians.count,
            log_scales=gaussians["log_scales"],
            logit_opacity=gaussians["logit_opacity"],
            statistic=self.stats.total(statistic) if statistic else self.stats.seen,
            divisor=self.stats.divisor(statistic) if statistic else self.stats.seen,
            copies=self.copies,
            kept=self.kept,
            shrink=self.shrink,
            gradient_above=gradient_above,
            size_above=size_above * self.measures.extent,
            size_below=MAX_BOUND if size_below is None else size_below * self.measures.extent,
            opacity_below=min(opacity_below, MAX_BOUND),
            new_shrink=shrink,
            new_copies=copies,
            new_kept=kept,
            stride=gaussians.capacity,
            count=gaussians.count,
        )

    def matching(self, statistic: str, other: str, gradient_above: float) -> float:
        """The threshold that as many Gaussians reach in `statistic` as reach `gradient_above` in `other`."""
        if self.gaussians.count == 0:
            return MIN_BOUND
        share = float(np.mean(self.stats.mean(other) >= np.float32(gradient_above)))
        return max(float(np.quantile(self.stats.mean(statistic), 1 - share)), MIN_BOUND)

    def threshold(self, statistic: str, threshold: Threshold) -> float:
        """The number that a threshold on a statistic stands for."""
        if isinstance(threshold, PixelQuantile):
            return self.measures.texture_quantile(threshold.quantile)
        if not isinstance(threshold, Quantile):
            return threshold
        mean = self.stats.mean(statistic)[self.gaussians.get(SEEN)[:, 0] > 0]
        return max(float(np.quantile(mean, threshold.quantile)), MIN_BOUND) if len(mean) else MIN_BOUND

    def choose(self, chosen: NDArray[np.bool_], copies: int, kept: int, shrink: float = 1.0) -> None:
        """Give the Gaussians that the host has chosen, [N], their outcome."""
        self._program.mark_chosen(
            items=self.gaussians.count,
            chosen=self.gaussians.device.upload(chosen.astype(np.uint32)),
            copies=self.copies,
            kept=self.kept,
            shrink=self.shrink,
            new_shrink=shrink,
            new_copies=copies,
            new_kept=kept,
            count=self.gaussians.count,
        )

    def rows(self) -> NDArray[np.uint32]:
        """How many rows each Gaussian will have, [N]."""
        return self.copies.get()

    def limit(self, most: int) -> None:
        """Take growth back until at most `most` rows remain: from the smallest values of the first column on."""
        rows, kept = self.rows().astype(np.int64), self.kept.get()
        growing = np.flatnonzero(rows > 1)
        score = self.stats.mean(self.stats.names[0]) if self.stats.names else np.zeros(len(rows), np.float32)
        order = growing[np.argsort(-score[growing], kind="stable")]
        total = int(np.minimum(rows, 1).sum()) + np.cumsum(rows[order] - 1)
        refused = order[total > most]
        rows[refused], kept[refused] = 1, 1
        self.copies.set(rows.astype(np.uint32))
        self.kept.set(kept)

    def apply(self, tiler: Tiler, seed: int) -> None:
        """Move all tables at once and place the children of split Gaussians."""
        gaussians, device, count = self.gaussians, self.gaussians.device, self.gaussians.count
        row_offset = tiler.scan(self.copies, count, "row_offset")
        rows = int(row_offset.get_item(count))
        source, fresh = device.empty(rows, np.uint32), device.empty(rows, np.uint32)
        self._program.list_rows(
            items=count,
            copies=self.copies,
            kept=self.kept,
            row_offset=row_offset,
            source=source,
            fresh=fresh,
            count=count,
        )
        gaussians.rearrange(source, fresh, rows)
        self._program.spawn_children(
            items=rows,
            source=source,
            kept=self.kept,
            shrink=self.shrink,
            quats=gaussians["quats"],
            means=gaussians["means"],
            log_scales=gaussians["log_scales"],
            seed=seed,
            step=self.step,
            stride=gaussians.capacity,
            count=rows,
        )


class Rule(Settings):
    """A condition and what it does to the Gaussians that meet it."""

    after: Annotated[int, Field(ge=0)] = 0  # global step from which, exclusive, the rule acts

    @property
    def statistics(self) -> set[str]:
        """Columns that the rule reads."""
        return set()

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the rule reads beside the parameters."""
        return set()

    def mark(self, edit: Edit) -> None:
        raise NotImplementedError


@dataclass(frozen=True)
class Change:
    """Numbers of Gaussians before and after an edit."""

    before: int
    after: int
    causes: dict[str, int]  # Gaussians whose fate a rule decided in the end, by the rule's name
    grown: dict[str, int]  # of these, the ones that became several


def densify(
    gaussians: Gaussians,
    stats: SplatStats,
    rules: Sequence[Rule],
    tiler: Tiler,
    measures: SceneScale,
    step: int,
    seed: int,
    most: int | None = None,
) -> Change:
    """Apply the rules in their order, as one rearrangement, and start the statistics anew.

    Growth stops at `most` Gaussians: those with the largest screen gradient (the first column) grow first.
    """
    edit = Edit(gaussians, stats, measures, step)
    before = gaussians.count
    acting = [rule for rule in rules if step > rule.after]
    decided_by = np.full(before, -1)
    for index, rule in enumerate(acting):
        rows = edit.rows()
        rule.mark(edit)
        decided_by[edit.rows() != rows] = index
    if most is not None and int(edit.rows().sum(dtype=np.int64)) > most:
        edit.limit(most)
    rows = edit.rows()
    decided_by[rows == 1] = -1
    causes: dict[str, int] = {}
    grown: dict[str, int] = {}
    for index, rule in enumerate(acting):
        name = getattr(rule, "type", "rule")
        causes[name] = causes.get(name, 0) + int((decided_by == index).sum())
        grown[name] = grown.get(name, 0) + int(((decided_by == index) & (rows > 1)).sum())
    edit.apply(tiler, seed)
    stats.clear()
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
