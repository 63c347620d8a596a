"""Where commands may write their results: not over a file of a run."""

from pathlib import Path

from clsplat.errors import ConfigError, DataError
from clsplat.files import is_there
from clsplat.names import CHECKSUMS, COMPARISON, RESERVED, STATUS
from clsplat.reading import read_json


def check_result(path: Path, suffix: str) -> None:
    """Raise ConfigError where a command would write a file of another kind, or over a file of a run."""
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{path}: expected the name of a file that ends in {suffix}")
    if path.name != COMPARISON:
        check_no_file_of_a_run(path)


def check_no_file_of_a_run(path: Path) -> None:
    """Raise ConfigError where a command would write over a file of a run."""
    folder = path.absolute().parent
    run = next(
        (one for one in (folder, *folder.parents) if any((one / n).is_file() for n in (CHECKSUMS, STATUS))), None
    )
    if run and is_there(path) and _is_of(run, path):
        raise ConfigError(f"{path}: is a file of a run; give another name")


def _is_of(run: Path, path: Path) -> bool:
    """Whether a run has written a file of its folder: all but what its list of checksums does not know."""
    name = path.absolute().relative_to(run).as_posix()
    try:
        listed = read_json(run / CHECKSUMS)
    except DataError:  # it has not ended, or is a matrix
        return True
    return not isinstance(listed, dict) or name in listed or name in RESERVED
