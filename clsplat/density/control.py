"""Apply density rules, as one edit; reset opacities (Kerbl et al. 2023, section 5)."""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray
from pydantic import Field, model_validator

from clsplat.core.errors import MemoryLimitError
from clsplat.core.schedule import Positive
from clsplat.core.settings import Settings
from clsplat.density.edit import MAX_ROWS, Edit, Rule
from clsplat.density.survey import SQUARE, WEIGHT, Look
from clsplat.density.thresholds import Share
from clsplat.formats.splats import inverse_opacities
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


# What Gaussians do to the pictures, over pixels and views, and pruning by it.

Score = Literal["weight", "sensitivity"]
Scoring = Callable[[Iterable[Look], int], NDArray[np.float32]]


@dataclass(frozen=True)
class Weights:
    """What each Gaussian is in some views."""

    total: NDArray[Any]  # [N] blend weight, alpha T, summed over all pixels; 0 where it is seen nowhere
    views: NDArray[np.int64]  # [N] in which it is useful; 0 where that was not asked for


def weights(looks: Iterable[Look], count: int, of_view: float | None = None, dtype: DTypeLike = np.float64) -> Weights:
    """Return the weights of N = `count` Gaussians, added in the order of the views.

    of_view: the share of a view's weight that is made by what is useful in it, the largest first; None: not counted.
    dtype: of the total.
    """
    total, views = np.zeros(count, dtype), np.zeros(count, np.int64)
    for look in looks:
        weight = look.sum(WEIGHT)
        total += weight
        if of_view is not None:
            views += largest_of(weight.astype(np.float64), of_view)
    return Weights(total, views)


def largest_of(weight: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """Return the fewest Gaussians, [N], that make this share of the weight; those without weight are none of them."""
    order = np.argsort(-weight, kind="stable")
    before = np.cumsum(weight[order]) - weight[order]
    found = np.zeros(len(weight), bool)
    found[order] = (before < share * weight.sum()) & (weight[order] > 0)
    return found


def contributions(looks: Iterable[Look], count: int) -> NDArray[np.float32]:
    """Return the blend weights, alpha T, summed over pixels and views, [N]; single precision decides near ties."""
    return weights(looks, count, dtype=np.float32).total


def sensitivities(looks: Iterable[Look], count: int) -> NDArray[np.float32]:
    """Return the squares of dI/dG summed over views and channels, [N]: I is a value of the image, G that of the
    Gaussian there, whose alpha is opacity times G (Speedy-Splat, Hanson et al. 2025).
    """
    total = np.zeros(count, np.float32)
    for look in looks:
        for channel in range(3):
            total += look.sum(SQUARE, channel=channel)
    return total


SCORES: dict[Score, Scoring] = {"weight": contributions, "sensitivity": sensitivities}


def best(score: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the places of the `count` largest scores, ascending; of equal ones the first."""
    return np.sort(np.argsort(-score, kind="stable")[:count])


def keep(gaussians: Gaussians, kept: NDArray[np.int64], cause: str) -> Change:
    """Remove all Gaussians but those in some rows, ascending.  cause: a name of what chose them."""
    before = gaussians.count
    source = gaussians.device.upload(kept.astype(np.uint32))
    gaussians.rearrange(source, gaussians.device.zeros(len(kept), np.uint32), len(kept))
    return Change(before, len(kept), {cause: before - len(kept)}, {})


# Choices of Gaussians: the largest scores, draws without replacement, the removal of some that are faint or large.

Mask = NDArray[np.bool_]


def drawn_order(candidates: Mask, weights: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.intp]:
    """Return the candidates, [N], as they are drawn one after another by their weights, 0 to infinity (Efraimidis and
    Spirakis 2006: by ln(U) / weight, the largest first)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        keys = np.log1p(-random.random(len(weights))) / weights
    places = np.flatnonzero(candidates)
    return places[np.argsort(-keys[places], kind="stable")]


def largest(candidates: Mask, score: NDArray[np.floating], limit: int) -> Mask:
    """Return which candidates, [N], have the largest scores: at most `limit` of them, ties by index."""
    places = np.flatnonzero(candidates)
    order = np.argsort(-score[places], kind="stable")
    chosen = np.zeros_like(candidates)
    chosen[places[order[:limit]]] = True
    return chosen


class SampledPruning(Rule):
    """Base of rules that remove a share of the faint and the large Gaussians, which is drawn."""

    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"share", "opacity_below", "size_above"})

    share: Share = 0.5
    """Share of the faint and large ones that is removed."""
    opacity_below: Positive = 0.005
    """Opacity of faint Gaussians; by step."""
    size_above: Positive = 0.1
    """Size of large Gaussians, largest standard deviation as a share of the extent; by step."""

    @abstractmethod
    def weights(self, edit: Edit) -> NDArray[np.float64]:
        """Return the weights of the draw, [N], 0 to infinity."""

    def mark(self, edit: Edit) -> None:
        """Sizes are those of the children after a split."""
        gaussians = edit.gaussians
        opacity = 1 / inverse_opacities(gaussians.get("logit_opacity")[:, 0])
        size = np.exp(gaussians.get("log_scales").max(axis=1)) * edit.shrink.get()
        large = size > edit.at(self.size_above) * edit.scene_scale.extent
        candidates = ((opacity < edit.at(self.opacity_below)) | large) & (edit.rows() > 0)
        order = drawn_order(candidates, self.weights(edit), edit.random())
        chosen = np.zeros_like(candidates)
        chosen[order[: int(self.share * len(order))]] = True
        edit.choose(chosen, copies=0, kept=0)
