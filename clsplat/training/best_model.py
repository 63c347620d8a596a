"""The best model of a training so far, by its validation views: what is known of it, and its tables on the host."""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from clsplat.core.errors import DataError
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import INTERVAL2, DeviceModel
from clsplat.gaussians.model import WIDTHS

FOLDER = "best/"  # before the names of its tables in a checkpoint
APART = 6.0  # dB: a model that is so much better where it was trained has learned its photographs by heart (ours)
Tables = dict[str, NDArray[np.float32]]
Count = Annotated[int, Field(ge=0)]


class Measured(BaseModel):
    """PSNR of one model, dB: means over training views, some or all, and over the validation views."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    step: Count
    train: float
    validation: float

    @property
    def is_apart(self) -> bool:
        """Whether the model has learned its photographs by heart."""
        return self.train - self.validation > APART

    def told(self, views: str) -> str:
        """Return it in words; views: what it calls those that were not trained on."""
        figures = f"{self.train:.1f} dB at training views and {self.validation:.1f} dB at {views} views"
        return f"At step {self.step:,} the model has {figures}{self.heart()}."

    def heart(self, first: "Measured | None" = None) -> str:
        """Return how far apart they are, in words; "" where that is little.  first: the first model that had more."""
        since = f" since step {first.step:,}" if first and first.step < self.step else ""
        return f", more than {APART:g} dB apart{since}: the photographs are learned by heart" if self.is_apart else ""


class Best(BaseModel):
    """What validation has found."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    found: Measured
    """Of the best model so far."""
    degree: Annotated[int, Field(ge=0, le=3)]
    """Active degree of its spherical harmonics."""
    metrics: dict[str, dict[str, Any]]
    """Its averages, by split and downscale."""
    scalars: dict[str, float] = {}
    """What parts of the run kept at its step."""
    modules: dict[str, dict[str, float]] = {}
    """The numbers of its modules, by name."""
    evaluations: Count
    """Number of measurements so far."""
    since: Count
    """Of them after the best."""
    apart: Measured | None
    """The first that had learned its photographs by heart."""
    last: Measured
    """The last that was measured."""
    growth_ended: Count | None = None
    """Global step from which on nothing grew, since validation found no better model; None: growth goes on."""
    taken: Count | None = None
    """Global step after which the training left this model; None: it goes on."""
    refit: Literal["none", "due", "begun"] = "none"
    """Whether all training photographs are trained on again, for so many steps."""

    def after(self, last: Measured) -> "Best":
        """The same with one more measurement, which was no better."""
        more = {"last": last, "evaluations": self.evaluations + 1, "since": self.since + 1}
        return self.model_copy(update=more | {"apart": self.apart or (last if last.is_apart else None)})

    def figures(self) -> dict[str, Any]:
        """Return what metrics.json has of it."""
        facts = self.model_dump(include={"evaluations", "last", "apart", "growth_ended"})
        return {**self.found.model_dump(), **facts, "ended": self.taken, "refit": self.refit != "none"}

    def told(self) -> str:
        """Return what happened, in words."""
        found, last = self.found, self.last
        both = f"{found.train:.1f} dB at training views and {found.validation:.1f} dB at validation views"
        text = f"By the validation views the model of step {found.step:,} is the best: {both}{found.heart()}."
        if last.step != found.step:
            apart = last.heart(self.apart)
            text += f" At step {last.step:,} it is {last.train:.1f} and {last.validation:.1f} dB{apart}."
        if self.refit != "none":
            return f"{text} All training photographs are then trained on for {found.step:,} steps."
        return f"{text} That model is kept." if self.taken is not None else text


def model_tables(model: DeviceModel) -> Tables:
    """Copy what a model needs to be rendered, and to be trained from anew, to the host."""
    gaussians = model.gaussians
    names = (*gaussians.trained, "filter_variance", *({INTERVAL2} & gaussians.tables.keys()))
    return {name: gaussians.get(name) for name in names}


def check(best: Best | None, tables: Tables) -> None:
    """Raise DataError for tables that are not those of the Gaussians of a best model."""
    if best is None or best.taken is not None:
        if tables:
            raise DataError("it holds a best model that it says nothing of")
        return
    if missing := [name for name in (*PARAMETERS, "filter_variance") if name not in tables]:
        raise DataError(f"its best model lacks {', '.join(missing)}")
    count = len(tables["means"])
    for name, table in tables.items():
        widths = WIDTHS.get(name, (1,))
        if table.shape not in {(count, width) for width in widths} or not count or not np.isfinite(table).all():
            raise DataError(f"{name} of its best model is not {count} rows of finite numbers")
