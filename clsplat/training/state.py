"""The notes of a checkpoint: all of a run's state but its tables."""

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

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
    degree: Annotated[int, Field(ge=0, le=3)]
    zero_fresh: list[str]
    updates: dict[str, Count]
    numbers: dict[str, float] = {}  # that parts of the run keep; older files have none
    train_seconds: float
    cpu_seconds: float = 0.0  # in the same time; older files have none
    metrics: dict[str, dict[str, Any]]
    records: Count  # lines of metrics.jsonl
    written: dict[str, str] = {}  # models, by path in the run folder, with their SHA-256; older files have none
    changes: list[str]
    device: str
    inputs: str  # identity of the scene
    pipeline: dict[str, Any]

    def is_trained(self, pipeline: dict[str, Any]) -> bool:
        """Whether all the steps that a resolved pipeline gives the training in progress are done."""
        (stage,) = pipeline["stages"][self.cursor].values()
        return bool(stage.get("steps") == self.stage_step)
