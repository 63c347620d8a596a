"""The folder of a run that was given none, and whether a folder has what a run would make."""

from collections.abc import Sequence
from pathlib import Path

from clsplat import lock
from clsplat.errors import OutputError
from clsplat.names import LOCK, PIPELINE
from clsplat.pipeline.loading import Pipeline
from clsplat.prepare.cache import Planned, note, noted
from clsplat.runs.course import is_complete
from clsplat.runs.folders import Start
from clsplat.runs.found import is_done_with


def free_folder(folder: Path, pipeline: Pipeline | None, start: Start) -> Path:
    """Return the default run folder: a new run beside one that is not up to date gets the next free number."""
    number, free = 1, folder
    planned = pipeline.preparation(folder) if pipeline else []

    def taken() -> bool:
        if (free / LOCK).exists():
            try:
                if not lock.check_free(free):
                    return True
            except OutputError:  # by a run that may not have begun yet
                return True
        return (free / PIPELINE).exists() and not (pipeline and is_same(pipeline, planned, free))

    while start == "new" and taken():
        number += 1
        free = folder.with_name(f"{folder.name}-{number}")
    return free


def start_of(pipeline: Pipeline, planned: Sequence[Planned], out: Path, start: Start) -> Start | None:
    """How a run begins in `out`; None: it is up to date.  One that is done goes on where files of it were lost."""
    if start == "restart" or not is_same(pipeline, planned, out):
        return start
    return None if is_complete(out) else "resume"


def is_same(pipeline: Pipeline, planned: Sequence[Planned], out: Path) -> bool:
    """Whether a run of this pipeline and the same photographs has come to its end in `out`; never where nothing is
    prepared."""
    return bool(planned) and noted(out) == note(planned) and is_done_with(pipeline, out)
