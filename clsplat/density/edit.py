"""Represent an edit of the Gaussians, and define the base class of density rules (Kerbl et al. 2023, section 5).

A rule sets the outcome of Gaussians: the number of rows that each becomes.  Most rules match a range of a statistic,
size, and opacity, and one kernel applies them; others select Gaussians on the host.  A size is the largest standard
deviation relative to the scene's extent.  The first growing rule that matches a Gaussian sets its outcome.  Pruning
rules override growth, and apply to the size of the children after a split.
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
    """Raise ValueError if a number of rows is below 0 or above MAX_ROWS."""
    for name, rows in (("copies", copies), ("old_rows", old_rows)):
        if not 0 <= rows <= MAX_ROWS:
            bound = "0 or more" if rows < 0 else f"at most {MAX_ROWS}"
            raise ValueError(f"{name}: expected a row count of {bound}, got {rows}")


def encode_outcomes(
    mask: NDArray[np.bool_], copies: int | NDArray[np.integer], old_rows: int, count: int
) -> NDArray[np.uint32]:
    """Return copies + 1 for the Gaussians in the mask, and 0 for the others, [N].

    count: the number of Gaussians, N.  Raises ValueError as `Edit.choose` does.
    """
    copies = np.asarray(copies)
    if mask.dtype != np.bool_ or mask.shape != (count,):
        raise ValueError(f"mask: expected bool [{count}], got {mask.dtype} {list(mask.shape)}")
    if not np.issubdtype(copies.dtype, np.integer) or copies.shape not in ((), (count,)):
        raise ValueError(
            f"copies: expected an integer, or integers of shape [{count}], got {copies.dtype} {list(copies.shape)}"
        )
    require_rows(int(copies.min(initial=0)), old_rows)
    require_rows(int(copies.max(initial=0)), old_rows)
    return np.where(mask, copies.astype(np.int64) + 1, 0).astype(np.uint32)


MAX_BOUND = 3.0e38  # an upper bound of all values
MIN_BOUND = 1.2e-38  # the smallest normal float, a lower bound of all positive values


class Edit:
    """An edit of the Gaussians: the outcome of each.

    An outcome consists of the number of rows that replace the Gaussian, the number of these that keep its moments and
    statistics, the factor on the scales of fresh rows, and whether the rows share its opacity.

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
        self.max_rows: int | None = None  # number of rows at which growth stops; None: no limit
        self.children: list[tuple[str, NDArray[np.integer], NDArray[np.floating]]] = []  # arguments of set_children
        self._program = device.program("density.cl")
        self._program.start_edit(items=count, **self._outcome, count=count)

    @property
    def _outcome(self) -> dict[str, Any]:
        return {"copies": self.copies, "old_rows": self.old_rows, "shrink": self.shrink, "shared": self.shared}

    @property
    def survey(self) -> Survey:
        """The survey of the training views with the Gaussians before the edit.  Raises ConfigError without views."""
        if self._survey is None:
            raise ConfigError("a rule needs training photos, but there are none; remove the rule")
        return self._survey

    def evaluate(self, schedule: Schedule) -> float:
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
        """Set the outcome of every Gaussian within the bounds; sizes are relative to the extent.

        copies, old_rows, shrink: as for `choose`.  shared: whether the rows together are as opaque as the old Gaussian.
        Raises ValueError for a number of rows below 0 or above MAX_ROWS.
        """
        require_rows(copies, old_rows)
        gaussians = self.gaussians
        self._program.mark_rule(
            items=gaussians.count,
            log_scales=gaussians["log_scales"],
            logit_opacity=gaussians["logit_opacity"],
            statistic=self.stats.total(statistic) if statistic else self.stats.view_count,
            divisor=self.stats.divisor(statistic) if statistic else self.stats.view_count,
            **self._outcome,
            gradient_above=gradient_above / self.stats.factor(statistic) if statistic else gradient_above,
            size_above=size_above * self.scene_scale.extent,
            size_below=MAX_BOUND if size_below is None else size_below * self.scene_scale.extent,
            opacity_below=min(opacity_below, MAX_BOUND),
            new_shrink=shrink,
            new_copies=copies,
            new_old_rows=old_rows,
            new_shared=int(shared),
            stride=gaussians.capacity,
            count=gaussians.count,
        )

    def matching_threshold(self, statistic: str, other: str, gradient_above: float) -> float:
        """Return the threshold on `statistic` that selects as many Gaussians as `gradient_above` selects by `other`."""
        if self.gaussians.count == 0:
            return MIN_BOUND
        fraction = float(np.mean(self.stats.mean(other) >= np.float32(gradient_above)))
        return max(float(np.quantile(self.stats.mean(statistic), 1 - fraction)), MIN_BOUND)

    def threshold(self, statistic: str, threshold: Threshold) -> float:
        """Return the value of a threshold on a statistic, at the step of the edit."""
        if isinstance(threshold, PixelQuantile):
            return self.scene_scale.texture_quantile(threshold.quantile)
        if not isinstance(threshold, Quantile):
            return self.evaluate(threshold)
        mean = self.stats.mean(statistic)[self.gaussians.get(SEEN)[:, 0] > 0]
        return max(float(np.quantile(mean, threshold.quantile)), MIN_BOUND) if len(mean) else MIN_BOUND

    def choose(
        self, mask: NDArray[np.bool_], copies: int | NDArray[np.integer], old_rows: int, shrink: float = 1.0
    ) -> None:
        """Set the outcome of the Gaussians in a mask, [N].

        copies: number of rows that replace each Gaussian, a scalar or [N].  old_rows: number of these that keep the
        Gaussian's moments and statistics; the others are fresh.  shrink: factor on the scales of fresh rows.
        Raises ValueError for a wrong shape or type, and for a number of rows below 0 or above MAX_ROWS.
        """
        count = self.gaussians.count
        self._program.mark_chosen(
            items=count,
            outcome=self.gaussians.device.upload(encode_outcomes(mask, copies, old_rows, count)),
            copies=self.copies,
            old_rows=self.old_rows,
            shrink=self.shrink,
            new_shrink=shrink,
            new_old_rows=old_rows,
            count=count,
        )

    def set_rows(self, name: str, rows: NDArray[np.integer], values: NDArray[np.floating]) -> None:
        """Write values, [n, components], into distinct rows, [n], of a table; the edit copies them to fresh rows."""
        self.gaussians.set_rows(name, rows, values)

    def set_children(self, name: str, rows: NDArray[np.integer], values: NDArray[np.floating]) -> None:
        """Set the values of a table for the rows that replace some Gaussians.

        rows: distinct Gaussians, [n].  values: [n, copies, components], for `copies` rows per Gaussian; ignored for a
        Gaussian whose growth is undone later.
        Raises ValueError for invalid rows (see `check_rows`) and for values of the wrong shape.
        """
        components = self.gaussians.tables[name].components
        if values.ndim != 3 or len(values) != len(rows) or values.shape[2] != components:
            raise ValueError(f"{name}: expected [{len(rows)}, copies, {components}], got {list(values.shape)}")
        self.children.append((name, check_rows(rows, self.gaussians.count), values))

    def zero_moments(self, rows: NDArray[np.integer], parameters: Collection[str] | None = None) -> None:
        """Set Adam's moments of distinct rows, [n], to zero.  parameters: their names; None for all trained ones."""
        parameter_names = self.gaussians.trained if parameters is None else parameters
        names = [table for parameter in parameter_names for table in moment_tables(parameter)]
        self.gaussians.zero_rows([name for name in names if name in self.gaussians.tables], rows)

    def row_counts(self) -> NDArray[np.uint32]:
        """Return the number of rows that each Gaussian becomes, [N]."""
        return self.copies.get()

    @property
    def room(self) -> int | None:
        """The number of rows that rules may still add, negative above the limit; None if there is no limit."""
        return None if self.max_rows is None else self.max_rows - int(self.row_counts().sum(dtype=np.int64))

    def undo_growth(self, mask: NDArray[np.bool_]) -> None:
        """Undo the growth of the Gaussians in a mask, [N], so that the edit does not change them."""
        mask = mask & (self.row_counts() > 1)
        for array, unchanged_value in zip(self._outcome.values(), (1, 1, 1, 0), strict=True):
            array.set(np.where(mask, unchanged_value, array.get()))

    def limit(self, limit: int) -> None:
        """Undo growth until at most `limit` rows remain.

        The growth of Gaussians with the smallest means of the first scalar statistic is undone first.
        """
        rows = self.row_counts().astype(np.int64)
        growing_rows = np.flatnonzero(rows > 1)
        scalars = [name for name, column in self.stats.columns.items() if column.components == 1]
        score = self.stats.mean(scalars[0]) if scalars else np.zeros(len(rows), np.float32)
        order = growing_rows[np.argsort(-score[growing_rows], kind="stable")]
        total = int(np.minimum(rows, 1).sum()) + np.cumsum(rows[order] - 1)
        undo_mask = np.zeros(len(rows), bool)
        undo_mask[order[total > limit]] = True
        self.undo_growth(undo_mask)


class Rule(Settings):
    """A condition on Gaussians, and the outcome of the Gaussians that meet it."""

    training_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    grows: ClassVar[bool] = True  # whether the rule may add Gaussians

    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which the rule acts."""

    @property
    def statistics(self) -> set[str]:
        """The names of the statistics that the rule reads."""
        return set()

    @property
    def tables(self) -> set[str]:
        """Names of the tables that the rule reads in addition to the parameters."""
        return set()

    @property
    def columns(self) -> list[type[Statistic]]:
        """The classes of the rule's statistics and of their divisors."""
        classes = variants(Statistic)
        statistic_classes = [classes[name] for name in self.statistics if name in classes]
        return [*statistic_classes, *(classes[cls.divisor] for cls in statistic_classes if cls.divisor in classes)]

    def active_conflicts(self) -> Mapping[str, str]:
        conflicts = dict(self.conflicts)
        for column in self.columns:
            conflicts |= column.conflicts
        return conflicts

    @abstractmethod
    def mark(self, edit: Edit) -> None:
        """Apply the rule: set outcomes with `edit.mark` or `edit.choose`, and table rows with `edit.set_rows`."""
