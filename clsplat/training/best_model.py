"""Record the best model of a training, chosen by its validation views: its metrics, and its tables on the host."""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from clsplat.core.errors import DataError
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import INTERVAL2, DeviceModel
from clsplat.gaussians.model import WIDTHS

FOLDER = "best/"  # before the names of its tables in a checkpoint
OVERFIT_GAP = 6.0  # dB, from the PSNR of training views to that of others (ours)
Tables = dict[str, NDArray[np.float32]]
Count = Annotated[int, Field(ge=0)]


class Measured(BaseModel):
    """The mean PSNR of one model, dB, over training views, some or all, and over the validation views."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    step: Count
    train: float
    validation: float

    @property
    def is_overfit(self) -> bool:
        return self.train - self.validation > OVERFIT_GAP

    def text(self, views: str) -> str:
        """Describe the model in a sentence.  views: name of the views that were not trained on."""
        figures = f"{self.train:.1f} dB at training views and {self.validation:.1f} dB at {views} views"
        return f"At step {self.step:,} the model has {figures}{self.overfit_text()}."

    def overfit_text(self, first: "Measured | None" = None) -> str:
        """Return a clause that says so if the model overfits, else "".  first: the first model that did."""
        since = f" since step {first.step:,}" if first and first.step < self.step else ""
        return f", more than {OVERFIT_GAP:g} dB apart{since}: the model overfits" if self.is_overfit else ""


class Best(BaseModel):
    """The best model so far, and the course of validation."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    measured: Measured
    """Of the best model so far."""
    degree: Annotated[int, Field(ge=0, le=3)]
    """Active degree of its spherical harmonics."""
    metrics: dict[str, dict[str, Any]]
    """Its averages, by split and downscale."""
    scalars: dict[str, float] = {}
    """The scalars of the run at its step."""
    modules: dict[str, dict[str, float]] = {}
    """The scalars of its modules, by type."""
    evaluations: Count
    """Number of measurements so far."""
    since_best: Count
    """Number of measurements after the best."""
    first_overfit: Measured | None
    """The first model that overfitted."""
    last: Measured
    """The last that was measured."""
    growth_ended: Count | None = None
    """Global step at which growth stopped, because validation no longer improved; None: growth continues."""
    ended: Count | None = None
    """Global step at which the training ended with this model; None: it continues."""
    refit: Literal["none", "due", "begun"] = "none"
    """Whether training is repeated on all training photographs, for the same number of steps."""

    def after(self, last: Measured) -> "Best":
        """Return the record after one more measurement that was no better."""
        more = {"last": last, "evaluations": self.evaluations + 1, "since_best": self.since_best + 1}
        first_overfit = self.first_overfit or (last if last.is_overfit else None)
        return self.model_copy(update=more | {"first_overfit": first_overfit})

    def figures(self) -> dict[str, Any]:
        """Return its entry in metrics.json."""
        facts = self.model_dump(include={"evaluations", "last", "first_overfit", "growth_ended", "ended"})
        return {**self.measured.model_dump(), **facts, "refit": self.refit != "none"}

    def text(self) -> str:
        """Describe the outcome in one or two sentences."""
        best, last = self.measured, self.last
        figures = f"{best.train:.1f} dB at training views and {best.validation:.1f} dB at validation views"
        text = f"By the validation views, the model of step {best.step:,} is the best: {figures}{best.overfit_text()}."
        if last.step != best.step:
            overfit = last.overfit_text(self.first_overfit)
            text += f" At step {last.step:,} it is {last.train:.1f} and {last.validation:.1f} dB{overfit}."
        if self.refit != "none":
            return f"{text} Training is then repeated on all training photographs for {best.step:,} steps."
        return f"{text} That model is kept." if self.ended is not None else text


def model_tables(model: DeviceModel) -> Tables:
    """Copy the tables that rendering a model, and training it from new moments, need to the host."""
    gaussians = model.gaussians
    names = (*gaussians.trained, "filter_variance", *({INTERVAL2} & gaussians.tables.keys()))
    return {name: gaussians.get(name) for name in names}


def check(best: Best | None, tables: Tables) -> None:
    """Raise DataError if tables cannot be those of the Gaussians of a best model."""
    if best is None or best.ended is not None:
        if tables:
            raise DataError("it has the tables of a best model, but no record of one")
        return
    if missing := [name for name in (*PARAMETERS, "filter_variance") if name not in tables]:
        raise DataError(f"its best model lacks {', '.join(missing)}")
    count = len(tables["means"])
    for name, table in tables.items():
        widths = WIDTHS.get(name, (1,))
        if table.shape not in {(count, width) for width in widths} or not count or not np.isfinite(table).all():
            raise DataError(f"{name} of its best model is not a table of {count} rows of finite numbers")
