"""Represent an edit of the Gaussians, and define the base class of density rules (Kerbl et al. 2023, section 5).

A rule gives Gaussians an outcome: the number of rows that each becomes.  Most rules are a range of a statistic, size,
and opacity, and one kernel applies them; others choose Gaussians on the host.  A size is the largest standard deviation
relative to the scene's extent.  The first growing rule that matches a Gaussian decides.  Pruning rules override growth,
and compare the size of the children after a split.
"""

import math
from abc import abstractmethod
from collections.abc import Collection, Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Schedule, at_step
from clsplat.core.settings import Settings, variants
from clsplat.density.statistics import SEEN, SplatStats, Statistic
from clsplat.density.survey import Survey
from clsplat.density.thresholds import PixelQuantile, Quantile, SceneScale, Threshold
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import check_rows, moment_tables

MAX_ROWS = 2**32 - 2  # cl_kernels/scan.cl saturates at 2**32 - 1, which marks an overflow


def require_rows(copies: int, old_rows: int) -> None:
    """Raise ValueError for numbers of rows that are negative or too large."""
    for name, number in (("copies", copies), ("old_rows", old_rows)):
        if not 0 <= number <= MAX_ROWS:
            bound = "0 or more" if number < 0 else f"at most {MAX_ROWS}"
            raise ValueError(f"{name}: expected a number of rows, {bound}, got {number}")


def encode_outcomes(
    chosen: NDArray[np.bool_], copies: int | NDArray[np.integer], old_rows: int, count: int
) -> NDArray[np.uint32]:
    """Return copies + 1 for the chosen Gaussians, 0 for the others, [N].  Raises ValueError like `Edit.choose`."""
    numbers = np.asarray(copies)
    if chosen.dtype != np.bool_ or chosen.shape != (count,):
        raise ValueError(f"chosen: expected a mask, bool [{count}], got {chosen.dtype} {list(chosen.shape)}")
    if not np.issubdtype(numbers.dtype, np.integer) or numbers.shape not in ((), (count,)):
        raise ValueError(
            f"copies: expected an integer or integers [{count}], got {numbers.dtype} {list(numbers.shape)}"
        )
    require_rows(int(numbers.min(initial=0)), old_rows)
    require_rows(int(numbers.max(initial=0)), old_rows)
    return np.where(chosen, numbers.astype(np.int64) + 1, 0).astype(np.uint32)


MAX_BOUND = 3.0e38  # a bound above all values
MIN_BOUND = 1.2e-38  # the smallest normal float: a bound that every value except zero reaches


class Edit:
    """The outcome of each Gaussian.

    This is the number of rows that it becomes, how many of them are the old row, the factor on the scales of fresh
    rows, and whether they share its opacity.

    Random numbers depend only on `seed`, `step`, and the rule.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        stats: SplatStats,
        scene_scale: SceneScale,
        step: int,
        seed: int,
        survey: Survey | None = None,
    ) -> None:
        device, count = gaussians.device, gaussians.count
        self.gaussians, self.stats, self.scene_scale = gaussians, stats, scene_scale
        self.step, self.seed, self._survey = step, seed, survey
        self.copies = device.empty(count, np.uint32)
        self.old_rows = device.empty(count, np.uint32)
        self.shrink = device.empty(count)
        self.shared = device.empty(count, np.uint32)
        self.rule = 0  # index of the rule that is marking
        self.max_rows: int | None = None  # rows at which growth stops; None: no limit
        self.children: list[tuple[str, NDArray[np.integer], NDArray[np.floating]]] = []  # arguments of set_children
        self._program = device.program("density.cl")
        self._program.start_edit(items=count, **self._outcome, count=count)

    @property
    def _outcome(self) -> dict[str, Any]:
        return {"copies": self.copies, "kept": self.old_rows, "shrink": self.shrink, "shared": self.shared}

    @property
    def survey(self) -> Survey:
        """The training views, rendered with the Gaussians before the edit.  Raises ConfigError if there are none."""
        if self._survey is None:
            raise ConfigError("a rule needs training photographs, and there are none; remove the rule")
        return self._survey

    def at(self, schedule: Schedule) -> float:
        """Return the value of a schedule at the step of the edit."""
        return at_step(schedule, self.step)

    def random(self) -> np.random.Generator:
        """Return a random number generator that depends only on the seed, the step, and the rule."""
        return np.random.default_rng([self.seed, self.step, self.rule])

    def mark(
        self,
        copies: int,
        old_rows: int,
        shrink: float = 1.0,
        statistic: str | None = None,
        gradient_above: float = 0.0,
        size_above: float = 0.0,
        size_below: float | None = None,
        opacity_below: float = math.inf,
        shared: bool = False,
    ) -> None:
        """Give an outcome to every Gaussian within the bounds; sizes are relative to the extent.

        copies, old_rows, shrink: as for `choose`.  shared: the rows together are as opaque as the old Gaussian.  Raises
        ValueError for numbers of rows that are negative or too large.
        """
        require_rows(copies, old_rows)
        gaussians = self.gaussians
        self._program.mark_rule(
            items=gaussians.count,
            log_scales=gaussians["log_scales"],
            logit_opacity=gaussians["logit_opacity"],
            statistic=self.stats.total(statistic) if statistic else self.stats.seen,
            divisor=self.stats.divisor(statistic) if statistic else self.stats.seen,
            **self._outcome,
            gradient_above=gradient_above / self.stats.factor(statistic) if statistic else gradient_above,
            size_above=size_above * self.scene_scale.extent,
            size_below=MAX_BOUND if size_below is None else size_below * self.scene_scale.extent,
            opacity_below=min(opacity_below, MAX_BOUND),
            new_shrink=shrink,
            new_copies=copies,
            new_kept=old_rows,
            new_shared=int(shared),
            stride=gaussians.capacity,
            count=gaussians.count,
        )

    def matching_threshold(self, statistic: str, other: str, gradient_above: float) -> float:
        """Return a threshold on `statistic` that the same number of Gaussians reach as `gradient_above` in `other`."""
        if self.gaussians.count == 0:
            return MIN_BOUND
        fraction = float(np.mean(self.stats.mean(other) >= np.float32(gradient_above)))
        return max(float(np.quantile(self.stats.mean(statistic), 1 - fraction)), MIN_BOUND)

    def threshold(self, statistic: str, threshold: Threshold) -> float:
        """Return a threshold on a statistic as a number, at the step of the edit."""
        if isinstance(threshold, PixelQuantile):
            return self.scene_scale.texture_quantile(threshold.quantile)
        if not isinstance(threshold, Quantile):
            return self.at(threshold)
        mean = self.stats.mean(statistic)[self.gaussians.get(SEEN)[:, 0] > 0]
        return max(float(np.quantile(mean, threshold.quantile)), MIN_BOUND) if len(mean) else MIN_BOUND

    def choose(
        self, chosen: NDArray[np.bool_], copies: int | NDArray[np.integer], old_rows: int, shrink: float = 1.0
    ) -> None:
        """Give an outcome to the Gaussians of a mask, [N].

        copies: number of rows that each becomes, one number or [N].  old_rows: how many of them are the old row, with
        its moments and statistics; the others are fresh.  shrink: factor on the scales of fresh rows.
        Raises ValueError for a wrong shape or type, and for numbers of rows below 0 or above MAX_ROWS.
        """
        count = self.gaussians.count
        self._program.mark_chosen(
            items=count,
            outcome=self.gaussians.device.upload(encode_outcomes(chosen, copies, old_rows, count)),
            copies=self.copies,
            kept=self.old_rows,
            shrink=self.shrink,
            new_shrink=shrink,
            new_kept=old_rows,
            count=count,
        )

    def set_rows(self, name: str, rows: NDArray[np.integer], values: NDArray[np.floating]) -> None:
        """Write values, [n, components], into distinct rows, [n], of a table; fresh rows copy them."""
        self.gaussians.set_rows(name, rows, values)

    def set_children(self, name: str, rows: NDArray[np.integer], values: NDArray[np.floating]) -> None:
        """Write values, [n, copies, components], of a table into the rows that distinct Gaussians, [n], become.

        Gaussians that finally become a different number of rows, because growth was undone, are not changed.  Raises
        ValueError for invalid rows (`check_rows`) and for values of a wrong shape.
        """
        components = self.gaussians.tables[name].components
        if values.ndim != 3 or len(values) != len(rows) or values.shape[2] != components:
            raise ValueError(f"{name}: expected [{len(rows)}, copies, {components}], got {list(values.shape)}")
        self.children.append((name, check_rows(rows, self.gaussians.count), values))

    def zero_moments(self, rows: NDArray[np.integer], parameters: Collection[str] | None = None) -> None:
        """Set Adam's moments of distinct rows, [n], to zero, for some parameters or all trained ones."""
        trained = self.gaussians.trained if parameters is None else parameters
        names = [table for parameter in trained for table in moment_tables(parameter)]
        self.gaussians.zero_rows([name for name in names if name in self.gaussians.tables], rows)

    def rows(self) -> NDArray[np.uint32]:
        """Return the number of rows that each Gaussian becomes, [N]."""
        return self.copies.get()

    @property
    def room(self) -> int | None:
        """The number of rows that rules may still add; negative if there are too many; None if there is no limit."""
        return None if self.max_rows is None else self.max_rows - int(self.rows().sum(dtype=np.int64))

    def undo_growth(self, mask: NDArray[np.bool_]) -> None:
        """Undo the growth of the Gaussians in a mask, [N], which then remain unchanged."""
        mask = mask & (self.rows() > 1)
        for array, unchanged in zip(self._outcome.values(), (1, 1, 1, 0), strict=True):
            array.set(np.where(mask, unchanged, array.get()))

    def limit(self, limit: int) -> None:
        """Undo growth until at most `limit` rows remain, first for the smallest means of the first scalar statistic."""
        rows = self.rows().astype(np.int64)
        growing = np.flatnonzero(rows > 1)
        scalars = [name for name, column in self.stats.columns.items() if column.components == 1]
        score = self.stats.mean(scalars[0]) if scalars else np.zeros(len(rows), np.float32)
        order = growing[np.argsort(-score[growing], kind="stable")]
        total = int(np.minimum(rows, 1).sum()) + np.cumsum(rows[order] - 1)
        mask = np.zeros(len(rows), bool)
        mask[order[total > limit]] = True
        self.undo_growth(mask)


class Rule(Settings):
    """A condition on Gaussians, and the outcome of the Gaussians that meet it."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    grows: ClassVar[bool] = True  # whether it may add Gaussians

    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which the rule acts."""

    @property
    def statistics(self) -> set[str]:
        """Names of the statistics that the rule reads."""
        return set()

    @property
    def tables(self) -> set[str]:
        """Tables of the Gaussians that the rule reads in addition to the parameters."""
        return set()

    @property
    def columns(self) -> list[type[Statistic]]:
        """The classes of the rule's statistics, and of the statistics that divide them."""
        classes = variants(Statistic)
        read = [classes[name] for name in self.statistics if name in classes]
        return [*read, *(classes[kind.divisor] for kind in read if kind.divisor in classes)]

    def active_conflicts(self) -> Mapping[str, str]:
        conflicts = dict(self.conflicts)
        for kind in self.columns:
            conflicts |= kind.conflicts
        return conflicts

    @abstractmethod
    def mark(self, edit: Edit) -> None:
        """Give outcomes with `edit.mark` or `edit.choose`; change rows of tables with `edit.set_rows`."""
