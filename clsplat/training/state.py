"""The notes of a checkpoint: all of a run's state but its tables."""

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from clsplat.errors import DataError
from clsplat.formats.motion import MOTION
from clsplat.gaussians.model import WIDTHS
from clsplat.gaussians.tables import PARAMETERS, moment_tables, sh_coefficients
from clsplat.training.archive import Arrays
from clsplat.training.kept import Best

Count = Annotated[int, Field(ge=0)]


class State(BaseModel):
    """What a checkpoint holds beside its tables."""

    model_config = ConfigDict(strict=True, extra="forbid")

    format: int
    version: str
    step: Count
    cursor: Count
    stage_step: Count
    acted: Count
    edited: bool
    field: dict[str, Any] | None  # kind, shape and parameters of the field that is trained instead of Gaussians
    degree: Annotated[int, Field(ge=0, le=3)]
    zero_fresh: list[str]
    updates: dict[str, Count]
    numbers: dict[str, float]  # that parts of the run keep
    best: Best | None  # what validation has found
    train_seconds: float
    cpu_seconds: float  # in the same time
    metrics: dict[str, dict[str, Any]]
    records: Count  # lines of metrics.jsonl
    written: dict[str, str]  # models, by path in the run folder, with their SHA-256
    changes: list[str]
    device: str
    inputs: str  # identity of the scene
    read: dict[str, str]  # hashes of the files that settings name, by their text
    pipeline: dict[str, Any]

    def is_trained(self, pipeline: dict[str, Any]) -> bool:
        """Whether all the steps that a resolved pipeline gives the training in progress are done."""
        (stage,) = pipeline["stages"][self.cursor].values()
        return bool(stage.get("steps") == self.stage_step)


def check_tables(state: State, tables: Arrays) -> None:
    """Raise DataError for tables that are not those of a run."""
    if missing := [name for name in PARAMETERS if name not in tables]:
        raise DataError(f"lacks {', '.join(missing)}")
    count = len(tables["means"])
    for name, table in tables.items():
        if table.dtype != np.float32 or table.ndim != 2 or len(table) != count:
            raise DataError(f"{name} is not [{count}, components] of float32")
    if count == 0:
        raise DataError("it holds no Gaussians")
    trained = [*PARAMETERS, *([MOTION] if MOTION in tables else [])]
    for name in trained:
        if tables[name].shape[1] not in WIDTHS[name]:
            raise DataError(f"{name} has {tables[name].shape[1]} components")
        if name == "sh_rest" and tables[name].shape[1] < 3 * (sh_coefficients(state.degree) - 1):
            raise DataError(f"{name} has {tables[name].shape[1]} components, too few for degree {state.degree}")
        moments = [moment for moment in moment_tables(name) if moment in tables]
        if broken := [key for key in (name, *moments) if not np.isfinite(tables[key]).all()]:
            raise DataError(f"{broken[0]} holds values that are not finite")
        if [tables[moment].shape for moment in moments] != [tables[name].shape] * (2 if state.updates else 0):
            raise DataError(f"the moments of {name} are not like it")
    if state.updates and state.updates.keys() != set(trained):
        raise DataError("it counts updates of other parameters")
