"""Clone, split, and prune Gaussians: adaptive density control (Kerbl et al. 2023, section 5)."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from clsplat.core.schedule import Positive
from clsplat.core.settings import variants
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import Statistic, StatisticName


class Grow(Rule):
    """Base class of rules that turn a Gaussian into several if the mean of a statistic is large.

    With `as_many_as`, the number of Gaussians that grow is the number that reach `gradient_above` in that statistic;
    the Gaussians with the largest `statistic` grow (Gaussian Opacity Fields, Yu et al. 2024).
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"gradient_above", "opacity"})

    statistic: StatisticName = "screen_grad"
    """Statistic whose mean is compared with `gradient_above`."""
    gradient_above: Positive = 2.0e-4
    """Smallest mean of the statistic, in its unit, at which a Gaussian grows."""
    as_many_as: StatisticName | None = None
    """Other statistic; the number of Gaussians that reach `gradient_above` in it sets the threshold of `statistic`."""

    opacity: Literal["copied", "shared"] = "copied"
    """`copied`: each child has the parent's opacity; `shared`: together they are as opaque as their parent,
    1 − (1 − o)^(1/n) each (Rota Bulò et al. 2024)."""

    @model_validator(mode="after")
    def _require_threshold(self) -> "Grow":
        name = self.as_many_as or self.statistic
        if variants(Statistic)[name].is_total and "gradient_above" not in self.model_fields_set:
            raise ValueError(f"the default 'gradient_above' is not in the unit of '{name}'; set it, for example to 200")
        return self

    @property
    def statistics(self) -> set[str]:
        return {self.statistic, self.as_many_as or self.statistic}

    def condition(self, edit: Edit) -> dict[str, Any]:
        """Return arguments of `Edit.mark`: the condition of the rule, and whether children share the opacity."""
        threshold = edit.evaluate(self.gradient_above)
        if self.as_many_as:
            threshold = edit.matching_threshold(self.statistic, self.as_many_as, threshold)
        return {"statistic": self.statistic, "gradient_above": threshold, "shared": self.opacity == "shared"}


class Clone(Grow):
    """Copy small Gaussians whose statistic is large; the copy starts at the same position."""

    type: Literal["clone"] = "clone"
    training_keys: ClassVar[frozenset[str]] = frozenset({"size_below"})

    size_below: Positive = 0.01
    """Size up to which a Gaussian is cloned: largest standard deviation as a fraction of the scene extent."""

    def mark(self, edit: Edit) -> None:
        edit.mark(copies=2, old_rows=1, size_below=edit.evaluate(self.size_below), **self.condition(edit))


class SplitLarge(Grow):
    """Replace each large Gaussian that has a large statistic with smaller ones at positions sampled from it."""

    type: Literal["split"] = "split"
    training_keys: ClassVar[frozenset[str]] = frozenset({"size_above", "children", "shrink"})

    size_above: Positive = 0.01
    """Size from which a Gaussian is split: largest standard deviation as a fraction of the scene extent."""
    children: Annotated[int, Field(ge=2, le=8)] = 2
    """Number of Gaussians that replace one."""
    shrink: Annotated[float, Field(ge=1)] = 1.6
    """Divisor of the children's scales."""

    def mark(self, edit: Edit) -> None:
        edit.mark(
            copies=self.children,
            old_rows=0,
            shrink=1.0 / self.shrink,
            size_above=edit.evaluate(self.size_above),
            **self.condition(edit),
        )


class PruneFaint(Rule):
    """Remove Gaussians that are almost transparent."""

    type: Literal["prune_faint"] = "prune_faint"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"opacity_below"})

    opacity_below: Positive = 0.005
    """Opacity below which a Gaussian is removed."""

    def mark(self, edit: Edit) -> None:
        edit.mark(copies=0, old_rows=0, opacity_below=edit.evaluate(self.opacity_below))


class PruneLarge(Rule):
    """Remove Gaussians that are large relative to the scene extent."""

    type: Literal["prune_large"] = "prune_large"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"size_above"})

    size_above: Positive = 0.1
    """Size above which a Gaussian is removed: largest standard deviation as a fraction of the scene extent."""

    def mark(self, edit: Edit) -> None:
        edit.mark(copies=0, old_rows=0, size_above=edit.evaluate(self.size_above))
