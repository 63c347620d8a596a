"""The contents of status.json: its schema, which `clsplat check` and `clsplat status` hold a file to."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from clsplat.errors import DataError

FORMAT: Literal[1] = 1
Whole = Annotated[int, Field(ge=0, lt=1 << 63)]
Seconds = Annotated[float, Field(gt=-1e15, lt=1e15)]


class Amount(BaseModel):
    """How much of a stage is done."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    done: Whole
    """Number of units that are done."""
    total: Whole
    """Number of units in all."""
    unit: str
    """What is counted, in words: steps, views, cells, photographs decoded, …"""


class Status(BaseModel):
    """The contents of status.json.  What does not apply, or is not known yet, is left out; newer versions may have more
    keys.  Times are in seconds since 1970, UTC.
    """

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    format: Literal[1]
    """Version of this schema: a key that is new does not change it, one that goes or has another meaning does."""
    state: Literal["starting", "preparing", "running", "done", "failed", "interrupted"]
    """starting: opens the device; preparing: makes and reads the scene; running: the stages; the others are the end."""
    stage: str | None = None
    """Stage or step of `prepare` in progress, or the last that was; of a matrix, the cell."""
    progress: Amount | None = None
    """How much of that stage is done, where it can be counted."""
    step: Whole | None = None
    """Training steps done, of all stages; not of a matrix."""
    steps: Whole | None = None
    """Step at which the training in progress ends."""
    gaussians: Whole | None = None
    """Number of Gaussians at the last report."""
    seconds_left: Seconds | None = None
    """Time that the training in progress still needs, estimated at the last report; of a preparation, reading the scene
    alone."""
    checkpoint: str | None = None
    """Newest checkpoint that was saved, a file in the folder `checkpoints`."""
    cells: Whole | None = None
    """Number of cells; of a matrix alone."""
    done: Whole | None = None
    """Number of cells that have ended; of a matrix alone."""
    failed: dict[str, str] | None = None
    """Names of the cells that failed, and why; of a matrix alone."""
    exit_code: int | None = None
    """Exit code of the run, when it has ended."""
    message: str | None = None
    """The one line that says why a run failed or was interrupted."""
    device: str | None = None
    """OpenCL device and runtime."""
    version: str
    """Version of clsplat."""
    host: str
    """Name of the machine, or of the container."""
    process: Whole
    """Number of the process on that machine."""
    pid_namespace: str | None = None
    """Linux: where that number counts; containers on one machine have their own."""
    boot: str | None = None
    """Linux: the start of the machine at which that number was given; the next one begins anew."""
    started: Seconds
    """When this process began with the run."""
    changed: Seconds
    """When state, stage, progress or step last changed."""
    time: Seconds
    """Heartbeat: when this file was written; at least every 10 s while the process lives."""


def status_of(content: Any) -> Status | None:
    """Return what a status.json holds; None where a newer version wrote it.

    Raises DataError with the first field that is wrong.
    """
    if isinstance(content, dict) and type(made := content.get("format")) is int and made > FORMAT:
        return None
    try:
        return Status.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from error


def status_schema() -> dict[str, Any]:
    """Return the JSON schema of status.json."""
    schema = Status.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
