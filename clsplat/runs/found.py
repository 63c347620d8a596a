"""What a folder holds of a run."""

from pathlib import Path

from clsplat.errors import DataError
from clsplat.names import CHECKSUMS, PIPELINE, STATUS
from clsplat.pipeline.loading import Pipeline, load
from clsplat.reading import read_json, sha256
from clsplat.training import checkpoint
from clsplat.training.status import read_status


def has_pipeline(folder: Path) -> bool:
    """Whether a folder holds the pipeline of a run, or of a matrix."""
    return (folder / PIPELINE).is_file()


def has_begun(out: Path) -> bool:
    """Whether a run has begun in a folder, whatever is left of it."""
    return (out / PIPELINE).exists() or bool(checkpoint.saved(out))


def has_state(folder: Path) -> bool:
    """Whether a folder holds a run or a matrix, or what one has said before it began."""
    return has_pipeline(folder) or (folder / STATUS).is_file()


def is_finished(out: Path) -> bool:
    """Whether a folder holds a run that is done, with every file as it was written."""
    if read_status(out).get("state") != "done":
        return False
    try:
        sums = read_json(out / CHECKSUMS)
        return isinstance(sums, dict) and all(sha256(out / name) == sum_ for name, sum_ in sums.items())
    except DataError:
        return False


def is_finished_run_of(pipeline: Pipeline, out: Path) -> bool:
    """Whether a folder holds the finished run of this pipeline."""
    return is_finished(out) and load(str(out / PIPELINE)).resolved() == pipeline.resolved()
