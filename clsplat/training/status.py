"""status.json: what a run is doing, for whoever watches it from outside."""

import json
import logging
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from clsplat.core.errors import DataError, OutputError
from clsplat.core.files import STATUS, write_text
from clsplat.core.machine import Owner
from clsplat.core.reading import read_json
from clsplat.core.resources import full_version

# The contents of status.json: its schema, which `clsplat check` and `clsplat status` hold a file to.

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


LOG = logging.getLogger("clsplat")
BEAT = 5.0  # seconds between two writes of a run that goes on
Item = TypeVar("Item")


class StatusFile:
    """The status.json of one run: held in memory, written at its beginning and end and every few seconds between.

    A thread does the writing in between, so that training never waits for a disk; where it fails, the run goes on.
    Where the folder is another's by now, nothing is written, and the run is told when it next says what it does.
    """

    def __init__(self, out: Path, require_held: Callable[[], None] = lambda: None, **values: Any) -> None:
        """`require_held` raises OutputError when the folder is no longer held."""
        self.out = out
        self.lost: OutputError | None = None  # what it has raised
        self._require_held = require_held
        now = time.time()
        before = read_status(out)
        checkpoint = before.get("checkpoint")
        self.was_done = before.get("state") == "done"  # the run that was in the folder before
        self.saved_at = time.monotonic()  # s, of the newest checkpoint, or of the beginning
        self.has_run = False  # so that the folder is no longer as that run has left it
        self.now = Status(
            format=FORMAT,
            state="starting",
            version=full_version(),
            **asdict(Owner.current()),
            started=now,
            changed=now,
            time=now,
            checkpoint=checkpoint if isinstance(checkpoint, str) else None,
            **values,
        )
        self._changing, self._writing = threading.Lock(), threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.seconds: dict[str, float] = {}  # spent in each stage that has ended, without those inside of it
        self._inside = 0.0  # seconds of the stages that have ended inside of the present one
        self._depth = 0  # of stages in progress
        self._warned = False

    def begin(self) -> None:
        """Write the first status and go on writing.  Raises OutputError."""
        self.write()
        self._beat()

    def require_held(self) -> None:
        """Raise OutputError when the run no longer holds its folder: before anything is written there."""
        try:
            self._require_held()
        except OutputError as error:
            self.lost = error
        if self.lost:
            raise self.lost

    def note(self, **values: Any) -> None:
        """Change fields; the next heartbeat writes them.  Raises OutputError where one has found the folder lost."""
        if self.lost:
            raise self.lost
        with self._changing:
            self.now = self.now.model_copy(update={"changed": time.time(), **values})

    def enter(self, state: Literal["preparing", "running"], **values: Any) -> None:
        """Change the state, and write it at once."""
        self.note(state=state, stage=None, progress=None, seconds_left=None, **values)
        self.has_run |= state == "running"
        self.refresh()
        self._beat()

    def end(self, state: Literal["done", "failed", "interrupted"], exit_code: int, message: str | None = None) -> None:
        """Write the last status.  Raises OutputError."""
        self.close()
        self.note(state=state, exit_code=exit_code, message=message, seconds_left=None)
        self.write()

    def close(self) -> None:
        """Write no more by itself."""
        self._ended.set()
        with self._writing:  # what is being written is no longer on its way
            pass

    def count(self, unit: str, done: int, total: int, **values: Any) -> None:
        """Note how much of the stage is done, and other fields."""
        self.note(progress=Amount(done=done, total=total, unit=unit), **values)

    def counted(self, items: Iterable[Item], unit: str, total: int) -> Iterator[Item]:
        """Yield the items and count them; what was yielded is done when the next is asked for."""
        for number, item in enumerate(items):
            self.count(unit, number, total)
            yield item
        self.count(unit, total, total)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Name the stage in progress; one inside of another gives way to it again, unless it fails.

        Raises OutputError when the folder is no longer held.
        """
        self.require_held()
        around = {"stage": self.now.stage, "progress": self.now.progress}
        start, before = time.perf_counter(), self._inside
        self._inside = 0.0
        self._depth += 1
        self.note(stage=name, progress=None)
        yield
        self._depth -= 1
        spent = time.perf_counter() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + spent - self._inside
        self._inside = before + spent
        if self._depth:
            self.note(**around)

    def refresh(self) -> None:
        """Write the status, before the end; where that fails the run goes on, with a warning the first time."""
        with self._writing:
            try:
                if not self._ended.is_set() and os.path.isdir(self.out):  # one that was removed stays so
                    self._write()
            except (OutputError, OSError) as error:
                if not self._warned and not self.lost:
                    LOG.warning("%s; the run goes on", error)
                self._warned = True

    def write(self) -> None:
        """Write the status now.  Raises OutputError."""
        with self._writing:  # whoever writes last writes the newest
            self._write()

    def _write(self) -> None:
        self.require_held()
        now = self.now.model_copy(update={"time": time.time()})
        write_text(self.out / STATUS, json.dumps(now.model_dump(exclude_none=True), indent=1) + "\n")

    def _beat(self) -> None:
        if self._thread is None and not self._ended.is_set():
            self._thread = threading.Thread(
                target=_refresh_until, args=(self._ended, weakref.ref(self)), name="status", daemon=True
            )
            self._thread.start()


def _refresh_until(ended: threading.Event, reference: "weakref.ref[StatusFile]") -> None:
    """Refresh a status until its run has ended, or nobody holds it any more."""
    while not ended.wait(BEAT):
        status = reference()
        if status is None:
            return
        status.refresh()
        del status


def read_status(out: Path) -> dict[str, Any]:
    """Return the contents of status.json; an empty dict when it is missing or damaged."""
    try:
        status = read_json(out / STATUS)
    except DataError:
        return {}
    return status if isinstance(status, dict) else {}
