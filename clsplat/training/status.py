"""Write status.json, which reports what a run is doing."""

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

# The schema of status.json, against which `clsplat check` and `clsplat status` validate a file.

FORMAT: Literal[1] = 1
Count = Annotated[int, Field(ge=0, lt=1 << 63)]
Seconds = Annotated[float, Field(gt=-1e15, lt=1e15)]


class StageProgress(BaseModel):
    """The progress of a stage."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    done: Count
    """Number of units done."""
    total: Count
    """Total number of units."""
    unit: str
    """What is counted, in words: steps, views, cells, photos decoded, …"""


class Status(BaseModel):
    """The contents of status.json.  Keys that do not apply or are not known yet are missing; newer versions may add
    keys.  Times are in seconds since 1970, UTC.
    """

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    format: Literal[1]
    """Version of this schema; it changes if a key is removed or changes its meaning, not if one is added."""
    state: Literal["starting", "preparing", "running", "done", "failed", "interrupted"]
    """starting: opens the device; preparing: prepares and reads the scene; running: runs stages; the rest are final."""
    stage: str | None = None
    """Current or last stage, or step of `prepare`; for a matrix, the current or last cell."""
    progress: StageProgress | None = None
    """Progress of that stage, if it can be counted."""
    step: Count | None = None
    """Training steps done in all stages; missing for a matrix."""
    steps: Count | None = None
    """Step at which the current training ends."""
    gaussians: Count | None = None
    """Number of Gaussians at the last report."""
    seconds_left: Seconds | None = None
    """Estimated remaining training time at the last report; during preparation, the time to read the scene."""
    checkpoint: str | None = None
    """Newest checkpoint, the name of a file in the folder `checkpoints`."""
    cells: Count | None = None
    """Number of cells of a matrix."""
    done: Count | None = None
    """Number of finished cells of a matrix."""
    failed: dict[str, str] | None = None
    """Failed cells of a matrix, with reasons."""
    store: str | None = None
    """Path of the store of a matrix's cells, if it has a store; `store` if it is in the folder of the matrix."""
    exit_code: int | None = None
    """Exit code of a run that ended."""
    message: str | None = None
    """Reason why the run failed or was interrupted."""
    device: str | None = None
    """OpenCL device and runtime."""
    version: str
    """Version of clsplat."""
    host: str
    """Name of the machine, or of the container."""
    process: Count
    """Process ID on that machine."""
    pid_namespace: str | None = None
    """Linux: the namespace of the process ID; each container has a separate namespace."""
    boot: str | None = None
    """Linux: ID of the boot in which that process ID is valid."""
    started: Seconds
    """When this process started the run."""
    changed: Seconds
    """When `state`, `stage`, `progress`, or `step` last changed."""
    time: Seconds
    """Heartbeat: when this file was written; at least every 10 s while the process lives."""


def parse_status(content: Any) -> Status | None:
    """Validate the contents of a status.json; return None if a newer version wrote it.

    Raises DataError, which names the first invalid field.
    """
    if isinstance(content, dict) and type(version := content.get("format")) is int and version > FORMAT:
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
HEARTBEAT_INTERVAL_S = 5.0  # s between writes
Item = TypeVar("Item")


class StatusFile:
    """The status.json of one run, written at its start and end, and every few seconds in between.

    A thread writes it, so that training never waits for the disk; if writing fails, the run continues.  If another run
    took over the folder, nothing is written, and the next `note` raises OutputError.
    """

    def __init__(self, out: Path, require_lock: Callable[[], None] = lambda: None, **values: Any) -> None:
        """require_lock: function that raises OutputError if the run no longer holds the folder's lock."""
        self.out = out
        self.lock_error: OutputError | None = None  # the error that `require_lock` raised
        self._require_lock = require_lock
        now = time.time()
        old_status = read_status(out)
        checkpoint, device = old_status.get("checkpoint"), old_status.get("device")
        self.was_done = old_status.get("state") == "done"  # whether an earlier run in the folder was done
        self.saved_at = time.monotonic()  # s, time of the newest checkpoint, or of the start
        self.has_run = False  # whether a stage has run
        self.now = Status(
            format=FORMAT,
            state="starting",
            version=full_version(),
            **asdict(Owner.current()),
            started=now,
            changed=now,
            time=now,
            checkpoint=checkpoint if isinstance(checkpoint, str) else None,
            **{"device": device if isinstance(device, str) else None, **values},
        )
        self._state_lock, self._write_lock = threading.Lock(), threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self.seconds: dict[str, float] = {}  # time of each stage, without nested stages
        self._nested_seconds = 0.0  # time of finished stages that are nested in the current one
        self._depth = 0  # number of nested stages
        self._warned = False

    def begin(self) -> None:
        """Write the first status and start the thread.  Raises OutputError."""
        self.write()
        self._start_heartbeat()

    def require_lock(self) -> None:
        """Raise OutputError if the run no longer holds the lock of its folder; called before each write there."""
        try:
            self._require_lock()
        except OutputError as error:
            self.lock_error = error
        if self.lock_error:
            raise self.lock_error

    def note(self, **values: Any) -> None:
        """Set fields, which the next heartbeat writes.  Raises OutputError if another run has taken over the folder."""
        if self.lock_error:
            raise self.lock_error
        with self._state_lock:
            self.now = self.now.model_copy(update={"changed": time.time(), **values})

    def enter(self, state: Literal["preparing", "running"], **values: Any) -> None:
        """Change the state, and write it immediately."""
        self.note(state=state, stage=None, progress=None, seconds_left=None, **values)
        self.has_run |= state == "running"
        self.refresh()
        self._start_heartbeat()

    def end(self, state: Literal["done", "failed", "interrupted"], exit_code: int, message: str | None = None) -> None:
        """Write the last status.  Raises OutputError."""
        self.close()
        self.note(state=state, exit_code=exit_code, message=message, seconds_left=None)
        self.write()

    def close(self) -> None:
        """Stop the thread."""
        self._ended.set()
        with self._write_lock:  # wait for a write in progress
            pass

    def count(self, unit: str, done: int, total: int, **values: Any) -> None:
        """Set the progress of the stage and other fields.  unit: what is counted, in words."""
        self.note(progress=StageProgress(done=done, total=total, unit=unit), **values)

    def counted(self, items: Iterable[Item], unit: str, total: int) -> Iterator[Item]:
        """Yield the items and report the progress.  An item counts as done when the next one is requested."""
        for number, item in enumerate(items):
            self.count(unit, number, total)
            yield item
        self.count(unit, total, total)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Set the current stage; when a nested stage ends without a failure, the outer one becomes current again.

        Raises OutputError if another run has taken over the folder.
        """
        self.require_lock()
        outer_fields = {"stage": self.now.stage, "progress": self.now.progress}
        start, outer_nested_seconds = time.perf_counter(), self._nested_seconds
        self._nested_seconds = 0.0
        self._depth += 1
        self.note(stage=name, progress=None)
        yield
        self._depth -= 1
        seconds = time.perf_counter() - start
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds - self._nested_seconds
        self._nested_seconds = outer_nested_seconds + seconds
        if self._depth:
            self.note(**outer_fields)

    def refresh(self) -> None:
        """Write the status of a run in progress; failures are logged once."""
        with self._write_lock:
            try:
                if not self._ended.is_set() and os.path.isdir(self.out):  # do not recreate a removed folder
                    self._write()
            except (OutputError, OSError) as error:
                if not self._warned and not self.lock_error:
                    LOG.warning("%s; the run continues", error)
                self._warned = True

    def write(self) -> None:
        """Write the status now.  Raises OutputError."""
        with self._write_lock:  # so that the newest status is written last
            self._write()

    def _write(self) -> None:
        self.require_lock()
        now = self.now.model_copy(update={"time": time.time()})
        write_text(self.out / STATUS, json.dumps(now.model_dump(exclude_none=True), indent=1) + "\n")

    def _start_heartbeat(self) -> None:
        if self._thread is None and not self._ended.is_set():
            self._thread = threading.Thread(
                target=_refresh_until, args=(self._ended, weakref.ref(self)), name="status", daemon=True
            )
            self._thread.start()


def _refresh_until(ended: threading.Event, reference: "weakref.ref[StatusFile]") -> None:
    """Refresh a status until its run ends or it is garbage-collected."""
    while not ended.wait(HEARTBEAT_INTERVAL_S):
        status = reference()
        if status is None:
            return
        status.refresh()
        del status


def read_status(out: Path) -> dict[str, Any]:
    """Return the contents of status.json; empty if it is missing or damaged."""
    try:
        status = read_json(out / STATUS)
    except DataError:
        return {}
    return status if isinstance(status, dict) else {}
