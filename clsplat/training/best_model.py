"""Record the best model by validation during training: its metrics, and its tables on the host."""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from clsplat.core.errors import DataError
from clsplat.formats.splats import PARAMETERS
from clsplat.gaussians.gaussians import INTERVAL2, DeviceModel
from clsplat.gaussians.model import WIDTHS

FOLDER = "best/"  # prefix of its tables in a checkpoint
OVERFIT_GAP = 6.0  # dB, between the PSNR of training views and other views (our choice)
Tables = dict[str, NDArray[np.float32]]
Count = Annotated[int, Field(ge=0)]


class Scores(BaseModel):
    """The mean PSNRs of a model, in dB: over all training views or a sample of them, and over the validation views."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    step: Count
    train: float
    validation: float

    @property
    def is_overfit(self) -> bool:
        return self.train - self.validation > OVERFIT_GAP

    def text(self, views: str) -> str:
        """Return a sentence with the scores.  views: `test` or `validation`."""
        psnrs = f"{self.train:.1f} dB on training views and {self.validation:.1f} dB on {views} views"
        return f"At step {self.step:,} the model has {psnrs}{self.overfit_text()}."

    def overfit_text(self, first: "Scores | None" = None) -> str:
        """Return a clause about overfitting, or "" without overfitting.  first: scores of the first overfit model."""
        since = f" since step {first.step:,}" if first and first.step < self.step else ""
        return f", more than {OVERFIT_GAP:g} dB apart{since}: the model overfits" if self.is_overfit else ""


class Best(BaseModel):
    """The best model so far, and the state of validation."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    measured: Scores
    """Scores of the best model so far."""
    degree: Annotated[int, Field(ge=0, le=3)]
    """Active degree of the spherical harmonics of the best model."""
    metrics: dict[str, dict[str, dict[str, Any]]]
    """Average metrics of the best model, by split and downscale."""
    scalars: dict[str, float] = {}
    """Scalars of the run at the step of the best model."""
    modules: dict[str, dict[str, float]] = {}
    """Scalars of the modules at the step of the best model, by module type."""
    evaluations: Count
    """Number of evaluations so far."""
    since_best: Count
    """Number of evaluations since the best model."""
    first_overfit: Scores | None
    """Scores of the first model that overfitted; None if none did."""
    last: Scores
    """Scores of the last model."""
    growth_ended: Count | None = None
    """Global step at which growth stopped because validation no longer improved; None while growth continues."""
    ended: Count | None = None
    """Global step at which training ended and kept this model; None while training continues."""
    refit: Literal["none", "due", "begun"] = "none"
    """State of the refit, which repeats training, including the validation photos, for the steps of the best model."""

    def with_last(self, last: Scores) -> "Best":
        """Return a copy of this record, updated with an evaluation in which the model did not improve."""
        changes = {"last": last, "evaluations": self.evaluations + 1, "since_best": self.since_best + 1}
        first_overfit = self.first_overfit or (last if last.is_overfit else None)
        return self.model_copy(update=changes | {"first_overfit": first_overfit})

    def summary(self) -> dict[str, Any]:
        """Return the entry of the best model in metrics.json."""
        progress = self.model_dump(include={"evaluations", "last", "first_overfit", "growth_ended", "ended"})
        return {**self.measured.model_dump(), **progress, "refit": self.refit != "none"}

    def text(self) -> str:
        """Return a few sentences about the outcome."""
        best, last = self.measured, self.last
        psnrs = f"{best.train:.1f} dB on training views and {best.validation:.1f} dB on validation views"
        text = f"On the validation views, the model of step {best.step:,} is the best: {psnrs}{best.overfit_text()}."
        if last.step != best.step:
            overfit = last.overfit_text(self.first_overfit)
            text += f" The model of step {last.step:,} has {last.train:.1f} and {last.validation:.1f} dB{overfit}."
        if self.refit != "none":
            return f"{text} Training is then repeated on all training photos for {best.step:,} steps."
        return f"{text} That model is kept." if self.ended is not None else text


def model_tables(model: DeviceModel) -> Tables:
    """Copy to the host the tables needed to render a model, or to train it further with new Adam moments."""
    gaussians = model.gaussians
    names = (*gaussians.trained, "filter_variance", *({INTERVAL2} & gaussians.tables.keys()))
    return {name: gaussians.get(name) for name in names}


def check(best: Best | None, tables: Tables) -> None:
    """Raise DataError if tables do not fit the Gaussians of the best model."""
    if best is None or best.ended is not None:
        if tables:
            raise DataError("it has the tables of a best model, but no record of one")
        return
    if missing_names := [name for name in (*PARAMETERS, "filter_variance") if name not in tables]:
        raise DataError(f"its best model lacks {', '.join(missing_names)}")
    count = len(tables["means"])
    for name, table in tables.items():
        widths = WIDTHS.get(name, (1,))
        if table.shape not in {(count, width) for width in widths} or not count or not np.isfinite(table).all():
            raise DataError(f"{name} of its best model is not a table of {count} rows of finite numbers")
