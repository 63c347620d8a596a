"""Run a cell in one or more attempts until it is published, fails, or is stopped, on behalf of any engine."""

import logging
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from clsplat.core.errors import (
    ClsplatError,
    ConfigError,
    DataError,
    Interrupted,
    MemoryLimitError,
    OutputError,
    one_line,
)
from clsplat.core.files import INPUTS, PREPARE_SUMMARY, PREPARED, UNDISTORTED, make_folder, write_text
from clsplat.core.reading import read_json
from clsplat.sweeps.cell import CellRun
from clsplat.sweeps.child import Command, supervise
from clsplat.sweeps.store import ATTEMPTS, PIPELINE_FILE, BitsMismatch, CellAttempt, CellFolder, LeaseLost, Store

LOG = logging.getLogger("clsplat")
FINAL_EXIT_CODES = (
    ConfigError.exit_code,
    DataError.exit_code,
    MemoryLimitError.exit_code,
)  # a retry would fail in the same way


@dataclass(frozen=True)
class Outcome:
    """The outcome of running a cell."""

    state: Literal["published", "failed", "stopped", "different"]
    bits: str = ""  # hash of the result's bits
    exit_code: int = 0
    message: str = ""


@dataclass(frozen=True)
class CellOptions:
    """Options for running a cell."""

    since: float  # when the sweep that requested the cell started, by the store's clock
    retries: int = 3  # maximum number of failures without a newer checkpoint
    worker: str = "inline"
    sweep: str = ""  # a name that requests to stop can use for all cells of the caller
    cores: Sequence[int] = ()  # cores that the run is pinned to; empty: the cores of the caller


def run_cell(
    cell: CellRun, store: Store, command: Command, options: CellOptions, is_stopped: Callable[[], bool] = lambda: False
) -> Outcome:
    """Run a cell, unless it is published already; return its outcome.  Failures are returned instead of raised.

    is_stopped: returns whether the caller has to stop.  Requests to stop in the store also stop the cell.
    """
    try:
        return _run_cell(cell, store, command, options, is_stopped)
    except BitsMismatch as error:
        return Outcome("different", "", error.exit_code, one_line(error))
    except ClsplatError as error:
        return Outcome("failed", "", error.exit_code, one_line(error))


def _run_cell(
    cell: CellRun, store: Store, command: Command, options: CellOptions, is_stopped: Callable[[], bool]
) -> Outcome:
    folder = store.add(cell)

    def should_stop() -> bool:
        return is_stopped() or store.is_cancelled((cell.key, options.sweep), options.since)

    while True:
        if manifest := folder.verified_manifest():
            store.log_event("skip", cell=cell.key, worker=options.worker)
            folder.clean_up(store.now())
            return Outcome("published", str(manifest["bits"]))
        if should_stop():
            return Outcome("stopped", "", Interrupted.exit_code, "stopped")
        cell.require_files()
        attempt = folder.begin(options.worker, options.since)
        start_checkpoint = attempt.lease.get("from")
        store.log_event(
            "start", cell=cell.key, attempt=attempt.path.name, worker=options.worker, **{"from": start_checkpoint}
        )
        _prepare_attempt(cell, store, folder, attempt)
        try:
            code = supervise(attempt, command, should_stop, options.cores)
            store.log_event("end", cell=cell.key, attempt=attempt.path.name, exit_code=code)
            if code == 0:
                _require_same_scene(cell, attempt)
                return _publish(store, folder, attempt)
            message = attempt.message(code)
        except LeaseLost:
            if folder.verified_manifest():  # published by another process while this one was frozen
                continue
            raise
        except BitsMismatch:
            raise
        except OutputError as error:  # raised while publishing; handled as a write error of the run
            code, message = error.exit_code, one_line(error)
            attempt.end(code)
        if should_stop():
            return Outcome("stopped", "", Interrupted.exit_code, "stopped, its state is saved")
        if code in FINAL_EXIT_CODES or len(folder.failures(options.since)) >= options.retries:
            return _give_up(folder, store, code, message)
        LOG.warning("cell %s: %s; trying again", cell.name, message)


def _prepare_attempt(cell: CellRun, store: Store, folder: CellFolder, attempt: CellAttempt) -> None:
    """Write the pipeline file of an attempt, and link the shared output of `prepare` and the undistorted photos.

    Where links are not possible, each cell creates these files itself.  Raises OutputError.
    """
    write_text(attempt.path / PIPELINE_FILE, cell.text)
    shared_folders = {UNDISTORTED: store.undistorted_folder(cell.spec["scene"], cell.spec["code"])}
    if cell.spec["pipeline"].get("prepare"):
        shared_folders[PREPARED] = store.prepared
    for name, target in shared_folders.items():
        make_folder(target)
        link = folder.path / ATTEMPTS / name
        if link.is_symlink() and not link.samefile(target):
            raise DataError(f"{link}: is a symbolic link that does not point to {target}; remove it")
        if not link.exists():
            with suppress(OSError):
                link.symlink_to(os.path.relpath(target, link.parent), target_is_directory=True)


def _require_same_scene(cell: CellRun, attempt: CellAttempt) -> None:
    """Raise DataError if the photos or other input files differ from the files hashed for the cell's key."""
    cell.require_files()
    for name, key in ((PREPARE_SUMMARY, "inputs"), (INPUTS, "digest")):
        if not (attempt.path / name).is_file():
            continue
        if read_json(attempt.path / name).get(key) != cell.spec["scene"]:
            raise DataError(
                f"cell {cell.name}: its photos, cameras, or points changed while it ran; run the sweep again"
            )
        return


def _publish(store: Store, folder: CellFolder, attempt: CellAttempt) -> Outcome:
    manifest = folder.publish(attempt)
    is_first = manifest["attempt"] == attempt.path.name
    store.log_event(
        "publish" if is_first else "second", cell=folder.key, attempt=attempt.path.name, bits=manifest["bits"]
    )
    folder.clean_up(store.now())
    return Outcome("published", str(manifest["bits"]))


def _give_up(folder: CellFolder, store: Store, code: int, message: str) -> Outcome:
    exit_code = code if code > 0 else 1
    folder.give_up(exit_code, message)
    store.log_event("failed", cell=folder.key, exit_code=exit_code)
    return Outcome("failed", "", exit_code, message)
