"""The run folder: made and held, cleared, left as it was by a run that has not begun."""

import shutil
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, get_args

from clsplat.core import lock
from clsplat.core.errors import ClsplatError, ConfigError, InternalError, OutputError, as_clsplat_error
from clsplat.core.files import (
    CHECKPOINTS,
    CHECKSUMS,
    EARLY_RUN_FILES,
    INPUTS,
    LOCK,
    METRICS,
    PIPELINE,
    PREPARE_SUMMARY,
    RECORDS,
    RUN_FILES,
    STATUS,
    TRIAL,
    make_folder,
    raising_output_error,
    remove_partial_files,
    write_text,
)
from clsplat.core.reading import read_text
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.matrix import load_experiment
from clsplat.prepare.cache import make_note, read_note
from clsplat.runs.state import Phase, RunState
from clsplat.training.status import StatusFile

RESOLVED = "# resolved from "  # the beginning of a pipeline.yaml that a single run has written
Start = Literal["new", "resume", "restart"]


@contextmanager
def opened(state: RunState, start: Start, **values: Any) -> Iterator[StatusFile]:
    """Make the run folder, swept of what killed runs have left, and its status with `values`; hold it in the block.

    A run that ends before its first step, without a checkpoint, leaves no new folder and no run in one that was there;
    one that was done before, and is refused before it goes on, stays done.
    Raises ConfigError when it holds another run, OutputError when it is in use or cannot be written.
    """
    check_run_folder(state, start)
    out = state.out
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    with raising_output_error(out):
        make_folder(out)
    try:
        with lock.lock_folder(out) as require_held:
            state = RunState.read(out)  # again, now that it is held: another process may have run there since
            check_run_folder(state, start)
            remove_partial_files(out, border=PIPELINE)
            before = read_text(out / STATUS) if state.phase is Phase.DONE else None
            status = StatusFile(out, require_held, **values)
            status.begin()
            try:
                with closing(status):  # the next holder writes its own
                    yield status
            except BaseException as error:
                if before is not None and not status.has_run:
                    with suppress(OutputError):
                        status.require_held()
                        write_text(out / STATUS, before)
                is_defect = isinstance(as_clsplat_error(error), InternalError)  # its log has the traceback
                if PIPELINE not in state.names and not status.now.step and not is_defect:
                    written = EARLY_RUN_FILES if status.now.cells else RUN_FILES - {CHECKPOINTS}
                    with suppress(OutputError):
                        status.require_held()
                        _remove_unused(out, written, kept={LOCK} if made else EARLY_RUN_FILES)
                raise
    except BaseException:
        with suppress(OSError):  # where a folder holds anything, it stays
            for folder in made:
                folder.rmdir()
        raise


def _remove_unused(out: Path, written: Collection[str], kept: Collection[str]) -> None:
    """Remove what a run has written that ended before its first step, but for the names to keep.

    Where anything else is there, a checkpoint or a file of others, nothing is removed.
    """
    with suppress(OSError):
        files = list(out.iterdir())
        if all(file.name in written for file in files):
            for file in files:
                if file.name not in kept:
                    shutil.rmtree(file) if file.is_dir() else file.unlink()


def clear(status: StatusFile) -> None:
    """Remove what a run would go on from.  Raises OutputError."""
    status.note(checkpoint=None)
    status.write()
    out = status.out
    states = (out / CHECKPOINTS).glob("*_[0-9]*.npz")  # failed and damaged ones too
    for file in [*states, *(out / name for name in (CHECKSUMS, METRICS, RECORDS, TRIAL, INPUTS, PREPARE_SUMMARY))]:
        with raising_output_error(file):
            file.unlink(missing_ok=True)


def _is_of_a_run(state: RunState) -> bool:
    """Whether a folder's pipeline.yaml, where there is one, was written by a run, or by that of a matrix."""
    out = state.out
    if PIPELINE not in state.names or STATUS in state.names or state.checkpoints:
        return True
    with suppress(ClsplatError):
        if read_text(out / PIPELINE).startswith(RESOLVED):
            return True
        found = load_experiment(str(out / PIPELINE))
        cells = found.cells if found else ()
        return any(read_text(out / cell.name / PIPELINE).startswith(RESOLVED) for cell in cells)
    return False


def check_run_folder(state: RunState, start: Start) -> None:
    """Raise ConfigError when a new run finds another one in its folder, or any finds a pipeline.yaml of the user's.

    Raises OutputError when a run that is to go on has lost its state.
    """
    out = state.out
    if start not in get_args(Start):
        raise ConfigError(f"no start '{start}'; there are {', '.join(get_args(Start))}")
    if not _is_of_a_run(state):
        raise ConfigError(
            f"{out / PIPELINE}: is not that of a run, which would write its own in its place; give another folder"
        )
    if start == "new" and state.phase >= Phase.BEGUN:
        raise ConfigError(f"{out}: already holds a run; give another folder, --resume or --restart")
    if start != "resume":
        return
    if state.phase is Phase.DONE and "cells" not in state.status and not state.checkpoints:
        raise ConfigError(f"{out}: is done, and has no checkpoint to go on from; {state.restart} trains it again")
    if state.phase is Phase.STATELESS:
        raise OutputError(
            f"{out}: has neither a readable {STATUS} nor a checkpoint, though a run has begun there; put them back, or "
            f"give {state.restart}, which begins it again"
        )


# The folder of a run that was given none, and whether a folder has what a run would make.


def free_folder(folder: Path, pipeline: Pipeline | None, start: Start) -> RunState:
    """Return the default run folder: a new run beside one that is not up to date gets the next free number."""
    number, state = 1, RunState.read(folder)

    def is_taken() -> bool:
        if LOCK in state.names:
            try:
                if not lock.check_free(state.out):
                    return True
            except OutputError:  # by a run that may not have begun yet
                return True
        return PIPELINE in state.names and not (pipeline and is_same(pipeline, state))

    while start == "new" and is_taken():
        number += 1
        state = RunState.read(folder.with_name(f"{folder.name}-{number}"))
    return state


def start_of(pipeline: Pipeline, state: RunState, start: Start) -> Start | None:
    """How a run begins in a folder; None: it is done, and whole.  One that is done goes on where files were lost."""
    if start == "new" and is_same(pipeline, state):
        start = "resume"
    return None if start == "resume" and state.is_whole(pipeline) else start


def is_same(pipeline: Pipeline, state: RunState) -> bool:
    """Whether a run of this pipeline and the same photographs is done; never where nothing is prepared."""
    if not pipeline.settings.prepare or state.phase is not Phase.DONE or state.difference(pipeline):
        return False
    return read_note(state.out) == make_note(pipeline.preparation(state.out))
