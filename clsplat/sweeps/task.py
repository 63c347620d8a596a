"""What every engine runs: one cell, in attempts, until it is published, given up or stopped."""

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
from clsplat.sweeps.store import ATTEMPTS, PIPELINE_FILE, CellAttempt, CellFolder, Different, LeaseLost, Store

LOG = logging.getLogger("clsplat")
FINAL = (ConfigError.exit_code, DataError.exit_code, MemoryLimitError.exit_code)  # the same run would end so again


@dataclass(frozen=True)
class Outcome:
    """How a cell ended."""

    state: Literal["published", "failed", "stopped", "different"]
    bits: str = ""  # of the result
    exit_code: int = 0
    message: str = ""


@dataclass(frozen=True)
class Terms:
    """What a caller lets a cell have."""

    since: float  # when the caller began, by the clock of the store
    retries: int = 3  # failures without a newer checkpoint
    worker: str = "inline"
    sweep: str = ""  # a name that the caller's cells are stopped by
    cores: Sequence[int] = ()  # that its run is kept to; none: those of its caller


def run_cell(
    cell: CellRun, store: Store, command: Command, terms: Terms, is_stopped: Callable[[], bool] = lambda: False
) -> Outcome:
    """Run a cell, unless it is published; return how it ended, whatever happens to it.

    is_stopped: whether the caller is to stop; the store is asked too.
    """
    try:
        return _run_cell(cell, store, command, terms, is_stopped)
    except Different as error:
        return Outcome("different", "", error.exit_code, one_line(error))
    except ClsplatError as error:
        return Outcome("failed", "", error.exit_code, one_line(error))


def _run_cell(cell: CellRun, store: Store, command: Command, terms: Terms, is_stopped: Callable[[], bool]) -> Outcome:
    folder = store.add(cell)

    def stopped() -> bool:
        return is_stopped() or store.is_cancelled((cell.key, terms.sweep), terms.since)

    while True:
        if found := folder.published():
            store.tell("skip", cell=cell.key, worker=terms.worker)
            folder.collect(store.now())
            return Outcome("published", str(found["bits"]))
        if stopped():
            return Outcome("stopped", "", Interrupted.exit_code, "stopped")
        cell.require_files()
        attempt = folder.begin(terms.worker, terms.since)
        begun_from = attempt.lease.get("from")
        store.tell("start", cell=cell.key, attempt=attempt.path.name, worker=terms.worker, **{"from": begun_from})
        _equip(cell, store, folder, attempt)
        try:
            code = supervise(attempt, command, stopped, terms.cores)
            store.tell("end", cell=cell.key, attempt=attempt.path.name, exit_code=code)
            if code == 0:
                _require_same_scene(cell, attempt)
                return _published(store, folder, attempt)
            message = attempt.message(code)
        except LeaseLost:
            if folder.published():  # by another process, while this one was frozen
                continue
            raise
        except Different:
            raise
        except OutputError as error:  # of its result: as if the run had not been able to write
            code, message = error.exit_code, one_line(error)
            attempt.end(code)
        if stopped():
            return Outcome("stopped", "", Interrupted.exit_code, "stopped, its state is saved")
        if code in FINAL or len(folder.failures(terms.since)) >= terms.retries:
            return _given_up(folder, store, code, message)
        LOG.warning("cell %s: %s; it is tried again", cell.name, message)


def _equip(cell: CellRun, store: Store, folder: CellFolder, attempt: CellAttempt) -> None:
    """Write the pipeline file of an attempt, and let it find what other cells have made of the scene.

    That is what `prepare` makes, and undistorted photographs.  Without links each cell makes its own.  Raises
    OutputError.
    """
    write_text(attempt.path / PIPELINE_FILE, cell.text)
    shared = {UNDISTORTED: store.undistorted(cell.spec["scene"], cell.spec["code"])}
    if cell.spec["pipeline"].get("prepare"):
        shared[PREPARED] = store.prepared
    for name, target in shared.items():
        make_folder(target)
        link = folder.path / ATTEMPTS / name
        if not link.exists():
            with suppress(OSError):
                link.symlink_to(os.path.relpath(target, link.parent), target_is_directory=True)


def _require_same_scene(cell: CellRun, attempt: CellAttempt) -> None:
    """Raise DataError where the photographs, or other files, are not those that the cell was named by."""
    cell.require_files()
    for name, key in ((PREPARE_SUMMARY, "inputs"), (INPUTS, "digest")):
        if not (attempt.path / name).is_file():
            continue
        if read_json(attempt.path / name).get(key) != cell.spec["scene"]:
            raise DataError(
                f"cell {cell.name}: its photographs, cameras or points changed while it ran; run the sweep again"
            )
        return


def _published(store: Store, folder: CellFolder, attempt: CellAttempt) -> Outcome:
    manifest = folder.publish(attempt)
    is_first = manifest["attempt"] == attempt.path.name
    store.tell("publish" if is_first else "second", cell=folder.key, attempt=attempt.path.name, bits=manifest["bits"])
    folder.collect(store.now())
    return Outcome("published", str(manifest["bits"]))


def _given_up(folder: CellFolder, store: Store, code: int, message: str) -> Outcome:
    exit_code = code if code > 0 else 1
    folder.give_up(exit_code, message)
    store.tell("failed", cell=folder.key, exit_code=exit_code)
    return Outcome("failed", "", exit_code, message)
