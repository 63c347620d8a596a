"""What a folder holds of a run."""

import logging
from contextlib import suppress
from pathlib import Path

from clsplat.errors import ConfigError, DataError
from clsplat.names import CHECKSUMS, PIPELINE, STATUS, is_inside
from clsplat.pipeline.loading import Pipeline, load
from clsplat.reading import read_json, sha256
from clsplat.training import checkpoint
from clsplat.training.status import read_status

LOG = logging.getLogger("clsplat")


def has_pipeline(folder: Path) -> bool:
    """Whether a folder holds the pipeline of a run, or of a matrix."""
    return (folder / PIPELINE).is_file()


def has_begun(out: Path) -> bool:
    """Whether a run has begun in a folder, whatever is left of it."""
    return (out / PIPELINE).exists() or bool(checkpoint.saved(out))


def has_state(folder: Path) -> bool:
    """Whether a folder holds a run or a matrix, or what one has said before it began."""
    return has_pipeline(folder) or (folder / STATUS).is_file()


def is_done(out: Path) -> bool:
    """Whether a run has come to its end in a folder, whose files may have been lost since."""
    return read_status(out).get("state") == "done"


def is_done_with(pipeline: Pipeline, out: Path) -> bool:
    """Whether that was a run of this pipeline."""
    with suppress(ConfigError):  # a damaged file
        return is_done(out) and load(str(out / PIPELINE)).resolved() == pipeline.resolved()
    return False


def changed(out: Path) -> list[Path]:
    """The files of a finished run that are missing or not as they were written; the list of them where that is lost."""
    try:
        sums = read_json(out / CHECKSUMS)
    except DataError:
        sums = None
    if not isinstance(sums, dict):
        return [out / CHECKSUMS]
    return [out / name for name, expected in sums.items() if is_inside(name) and not _is_whole(out / name, expected)]


def _is_whole(file: Path, expected: str) -> bool:
    with suppress(DataError):
        return sha256(file) == expected
    return False


def is_complete(out: Path) -> bool:
    """Whether a run that is done has its files, or as many as can be had without training again.

    What a checkpoint can bring back is not there yet; what none can is named in a warning.
    """
    lost = changed(out)
    if lost and not checkpoint.saved(out):
        LOG.warning("%s: is missing or was changed; without a checkpoint only --restart makes it again", lost[0])
    return not lost or not checkpoint.saved(out)
