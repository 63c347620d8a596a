"""Create, lock, and clear run folders; restore them if a run ends before its first step."""

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
from clsplat.prepare.cache import make_summary, read_summary
from clsplat.runs.state import Phase, RunState
from clsplat.training.status import StatusFile

RESOLVED = "# resolved from "  # first words of the pipeline.yaml of a single run
Start = Literal["new", "resume", "restart"]


@contextmanager
def open_run_folder(state: RunState, start: Start, **values: Any) -> Iterator[StatusFile]:
    """Create and lock the run folder, remove leftover files of killed runs, and yield the status file of the run.

    values: initial fields of the status.
    A run that ends before its first step, without a checkpoint, leaves no files behind.  A finished run stays finished
    if its continuation is rejected.
    Raises ConfigError if the folder has another run, and OutputError if it is in use or not writable.
    """
    check_run_folder(state, start)
    out = state.out
    new_folders = [folder for folder in (out, *out.parents) if not folder.exists()]
    with raising_output_error(out):
        make_folder(out)
    try:
        with lock.lock_folder(out) as require_lock:
            state = RunState.read(out)  # again: another process may have run there before the lock was taken
            check_run_folder(state, start)
            remove_partial_files(out, marker=PIPELINE)
            old_status = read_text(out / STATUS) if state.phase is Phase.DONE else None
            status = StatusFile(out, require_lock, **values)
            status.begin()
            try:
                with closing(status):  # the next owner of the folder writes another status
                    yield status
            except BaseException as error:
                if old_status is not None and not status.has_run:
                    with suppress(OutputError):
                        status.require_lock()
                        write_text(out / STATUS, old_status)
                is_defect = isinstance(as_clsplat_error(error), InternalError)  # keep the log, which has the traceback
                if PIPELINE not in state.names and not status.now.step and not is_defect:
                    removable_names = EARLY_RUN_FILES if status.now.cells else RUN_FILES - {CHECKPOINTS}
                    with suppress(OutputError):
                        status.require_lock()
                        _remove_unused(out, removable_names, kept_names={LOCK} if new_folders else EARLY_RUN_FILES)
                raise
    except BaseException:
        with suppress(OSError):  # a folder that is not empty stays
            for folder in new_folders:
                folder.rmdir()
        raise


def _remove_unused(out: Path, run_file_names: Collection[str], kept_names: Collection[str]) -> None:
    """Remove the files of a run that ended before its first step, except for `kept_names`.

    run_file_names: names that the run may have written.  Nothing is removed if the folder has other files, such as a
    checkpoint or a file of the user.
    """
    with suppress(OSError):
        files = list(out.iterdir())
        if all(file.name in run_file_names for file in files):
            for file in files:
                if file.name not in kept_names:
                    shutil.rmtree(file) if file.is_dir() else file.unlink()


def clear(status: StatusFile) -> None:
    """Remove the checkpoints and results of earlier runs.  Raises OutputError."""
    status.note(checkpoint=None)
    status.write()
    out = status.out
    checkpoints = (out / CHECKPOINTS).glob("*_[0-9]*.npz")  # failed and damaged ones too
    for file in [*checkpoints, *(out / name for name in (CHECKSUMS, METRICS, RECORDS, TRIAL, INPUTS, PREPARE_SUMMARY))]:
        with raising_output_error(file):
            file.unlink(missing_ok=True)


def _is_pipeline_from_run(state: RunState) -> bool:
    """Return whether a run or a matrix wrote the pipeline.yaml of a folder; True if there is no such file."""
    out = state.out
    if PIPELINE not in state.names or STATUS in state.names or state.checkpoints:
        return True
    with suppress(ClsplatError):
        if read_text(out / PIPELINE).startswith(RESOLVED):
            return True
        experiment = load_experiment(str(out / PIPELINE))
        cells = experiment.cells if experiment else ()
        return any(read_text(out / cell.name / PIPELINE).startswith(RESOLVED) for cell in cells)
    return False


def check_run_folder(state: RunState, start: Start) -> None:
    """Raise ConfigError if a run cannot start in a folder.

    Possible reasons: a new run would replace another run, no run wrote the folder's pipeline.yaml, or the finished run
    to resume has no checkpoint.  Raises OutputError if both the status and the checkpoints of a run to resume are
    missing.
    """
    out = state.out
    if start not in get_args(Start):
        raise ConfigError(f"start: expected one of {', '.join(get_args(Start))}, got '{start}'")
    if not _is_pipeline_from_run(state):
        raise ConfigError(f"{out / PIPELINE}: was not written by a run, and would be overwritten; use another folder")
    if start == "new" and state.phase >= Phase.BEGUN:
        raise ConfigError(f"{out}: already has a run; use another folder, --resume, or --restart")
    if start != "resume":
        return
    if state.phase is Phase.DONE and "cells" not in state.status and not state.checkpoints:
        raise ConfigError(
            f"{out}: is finished, but has no checkpoint to continue from; {state.restart_command} trains it again"
        )
    if state.phase is Phase.LOST_STATE:
        raise OutputError(
            f"{out}: both {STATUS} and the checkpoints of its run are missing; restore them, or start over with "
            f"{state.restart_command}"
        )


# The default folder of a run, and checks whether a folder already has the results of a run.


def find_free_folder(folder: Path, pipeline: Pipeline | None, start: Start) -> RunState:
    """Return the state of the default run folder, or of the next numbered folder that no other run uses."""
    number, state = 1, RunState.read(folder)

    def is_taken() -> bool:
        if LOCK in state.names:
            try:
                if not lock.check_free(state.out):
                    return True
            except OutputError:  # locked by a run that may not have started yet
                return True
        return PIPELINE in state.names and not (pipeline and is_up_to_date(pipeline, state))

    while start == "new" and is_taken():
        number += 1
        state = RunState.read(folder.with_name(f"{folder.name}-{number}"))
    return state


def choose_start(pipeline: Pipeline, state: RunState, start: Start) -> Start | None:
    """Return how a run starts in a folder, or None if it is complete.  A finished run with missing files resumes."""
    if start == "new" and is_up_to_date(pipeline, state):
        start = "resume"
    return None if start == "resume" and state.is_complete(pipeline) else start


def is_up_to_date(pipeline: Pipeline, state: RunState) -> bool:
    """Return whether a run of this pipeline on the same photos is finished; always False without `prepare` steps."""
    if not pipeline.settings.prepare or state.phase is not Phase.DONE or state.difference(pipeline):
        return False
    return read_summary(state.out) == make_summary(pipeline.preparation(state.out))
