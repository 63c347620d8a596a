"""Write files atomically: a reader sees a complete file or none, also after a power cut."""

import errno
import itertools
import logging
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PureWindowsPath
from typing import BinaryIO

from clsplat.core.errors import ConfigError, DataError, OutputError
from clsplat.core.machine import is_alive
from clsplat.core.reading import read_json

LOG = logging.getLogger("clsplat")
# what a process that was killed leaves: .NAME.PROCESS-NUMBER.partial
PARTIAL = re.compile(r"\..+\.(\d+)-\d+\.partial(\.\w+)?")
NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF, errno.EACCES, errno.EPERM}
SYSTEM = os.name
_number = itertools.count()
_open: set[str] = set()  # names of the temporary files that this process writes


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; when the block ends without an error, sync it and rename it to `path`.

    Then the folder is synced, so that the new name outlasts a power cut.
    Raises OutputError with the file's name when it cannot be written; an earlier file then stays unchanged.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic_path(path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a temporary path next to `path`, and rename it to `path` as `open_atomic` does.

    This is for libraries that open files themselves and look at the suffix.  The caller syncs the file.
    """
    if not path.name:
        raise OutputError(f"{path}: cannot be written (it has no name); expected the path of a file")
    temporary = _temporary(path, suffix)
    try:
        if path.exists() and not path.is_file():  # a rename would replace a device, too
            raise OutputError(f"{path}: cannot be written (it is not a file); give another name")
        make_folder(path.parent)
        yield temporary
        _replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        _open.discard(temporary.name)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a hidden folder beside `folder`, which takes its name when the block ends without an error.

    Those that killed processes left there are removed.  Who takes the folder syncs its files.
    Raises ConfigError where `folder` is in use, OutputError, before the block too, where it cannot be made.
    """
    require_free(folder)
    with scratch_folder(folder) as temporary:
        yield temporary
        with raising_output_error(folder):
            if folder.exists():
                folder.rmdir()  # it is empty; Windows replaces no folder
            _replace(temporary, folder)
            sync_folder(folder.parent)


@contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """Yield a hidden folder beside `folder`, which is removed at the end of the block.

    Those that killed processes left there are removed.  Raises OutputError, before the block, where it cannot be made.
    """
    temporary = _temporary(folder)
    try:
        with raising_output_error(folder):
            make_folder(folder.parent)
            temporary.mkdir()
            _sweep_beside(folder)
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        _open.discard(temporary.name)


def require_free(folder: Path) -> None:
    """Raise ConfigError where something but an empty folder lies at the place of a new one."""
    with raising_output_error(folder):
        is_free = not path_exists(folder) or (folder.is_dir() and not any(folder.iterdir()))
    if not (is_free and folder.name) or folder.is_symlink() or os.path.ismount(folder):  # which a rename cannot replace
        raise ConfigError(f"{folder}: is in use; give the name of a new folder")


@contextmanager
def raising_output_error(path: Path) -> Iterator[None]:
    """Raise OutputError, with the name of what cannot be written, for an OSError of the block."""
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from error


def _temporary(path: Path, suffix: str = "") -> Path:
    """A hidden name beside `path`, which this process writes now."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{next(_number)}.partial{suffix}")
    _open.add(temporary.name)
    return temporary


def _replace(temporary: Path, path: Path) -> None:
    """Rename; where Windows refuses because somebody reads the other one just now, try again for a second."""
    for attempt in range(20):
        try:
            return os.replace(temporary, path)
        except PermissionError:
            if SYSTEM != "nt" or attempt == 19:
                raise
            time.sleep(0.05)


def append(path: Path, data: bytes) -> None:
    """Append to a file and sync it; where that fails it is as it was.  Raises OutputError."""
    with raising_output_error(path):
        size = path.stat().st_size if path.exists() else None
        try:
            with path.open("ab") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            if size is None:
                sync_folder(path.parent)
        except OSError:
            with suppress(OSError):
                path.unlink() if size is None else os.truncate(path, size)
            raise


def make_folder(folder: Path) -> None:
    """Make a folder, with those above it, so that their names outlast a power cut.  Raises OSError."""
    new = list(itertools.takewhile(lambda one: not one.exists(), (folder, *folder.parents)))
    folder.mkdir(parents=True, exist_ok=True)
    for one in new:
        sync_folder(one.parent)


def sync_below(folder: Path) -> None:
    """Wait until the files below a folder, and their names, are on the disk; no link is followed.  Raises OSError."""
    for base, _, names in os.walk(folder):
        for path in (Path(base, name) for name in names):
            if path.is_file() and not path.is_symlink():
                _sync(path, os.O_RDWR if SYSTEM == "nt" else os.O_RDONLY)  # Windows syncs what may be written
        sync_folder(Path(base))


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk; without effect where a system cannot.  Raises OSError."""
    if hasattr(os, "O_DIRECTORY"):  # Windows writes names with the file
        _sync(folder, os.O_RDONLY | os.O_DIRECTORY)


def _sync(path: Path, flags: int) -> None:
    try:
        number = os.open(path, flags)
        try:
            os.fsync(number)
        finally:
            os.close(number)
    except OSError as error:
        if error.errno not in NO_SYNC:
            raise


def remove_partial_files(folder: Path, border: str) -> None:
    """Remove the temporary files of killed processes below a folder, but not below folders that hold a `border`."""
    for base, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not os.path.exists(os.path.join(base, name, border))]
        for name in filter(_is_left, files):
            with suppress(OSError):
                os.unlink(os.path.join(base, name))
                LOG.debug("removed %s, which a killed run has left", os.path.join(base, name))


def _sweep_beside(folder: Path) -> None:
    """Remove the temporary folders for one that killed processes have left."""
    with suppress(OSError):
        for path in folder.parent.iterdir():
            if path.name.startswith(f".{folder.name}.") and _is_left(path.name):
                shutil.rmtree(path, ignore_errors=True)
                LOG.debug("removed %s, which a killed process has left", path)


def _is_left(name: str) -> bool:
    """Whether a file or folder is a temporary one that no process of this machine writes any more."""
    if not (found := PARTIAL.fullmatch(name)) or name in _open:
        return False
    process = int(found[1])
    return process == os.getpid() or not is_alive(process)  # an earlier container had the same number


def path_exists(path: Path) -> bool:
    """Return whether something lies where a file or folder is to be made.  Raises OutputError where nothing can."""
    with raising_output_error(path):
        return path.exists() or path.is_symlink()


def write_error(path: Path, error: OSError) -> OutputError:
    """Return the OutputError for a file that cannot be written."""
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); check the folder and its space")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically.  Raises OutputError."""
    with open_atomic(path) as file:
        file.write(text.encode())


# Names of files: those that every system can hold, and those of a run folder that no pipeline may choose.

# What a run or a matrix writes itself, in its folder.
PIPELINE = "pipeline.yaml"
METRICS = "metrics.json"
RECORDS = "metrics.jsonl"
TRIAL = "trial.jsonl"
STATUS = "status.json"
LOG_FILE = "log.txt"
PREPARE_SUMMARY = "prepared.json"
INPUTS = "inputs.json"
CHECKSUMS = "checksums.json"
LOCK = "run.lock"
CHECKPOINTS = "checkpoints"
UNDISTORTED = "undistorted"
PREPARED = "prepared"
COMPARISON = "compare.html"
MODULE_FILE_PREFIX = "view_"  # what the side files of modules begin with
RESERVED = frozenset(
    {
        *(PIPELINE, METRICS, RECORDS, TRIAL, STATUS, LOG_FILE, PREPARE_SUMMARY, INPUTS, CHECKSUMS, LOCK),
        *(CHECKPOINTS, UNDISTORTED, PREPARED, COMPARISON, "cameras.json"),
    }
)
EARLY_RUN_FILES = frozenset({STATUS, LOG_FILE, LOCK, UNDISTORTED})  # written before pipeline.yaml
RUN_FILES = EARLY_RUN_FILES | {PIPELINE, METRICS, RECORDS, TRIAL, PREPARE_SUMMARY, INPUTS, CHECKSUMS, CHECKPOINTS}
MATRIX_FILES = frozenset({STATUS, LOCK, PIPELINE, COMPARISON})
END_STATES = ("done", "failed", "interrupted")  # of status.json
HEARTBEAT_TIMEOUT = 60  # seconds without a heartbeat there after which a run may have ended
MAX_NAME_BYTES = 200  # bytes; systems allow 255, and temporary names are longer
_DEVICES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³])(\..*)?", re.IGNORECASE)  # of Windows


def invalid_name_reason(name: str) -> str | None:
    """Return why not every system can hold a file of this name, or None."""
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        return f"{name!r} is not text"
    if size > MAX_NAME_BYTES:
        return f"a name has {size} bytes; the limit is {MAX_NAME_BYTES}"
    if any(letter < " " or letter in '<>:"|?*\x7f' for letter in name):
        return f"{name!r} holds a character that not every system allows"
    if _DEVICES.fullmatch(name.rstrip(" .")) or re.search(r"~\d", name) or name != name.rstrip(" ."):
        return f"'{name}' means something else on Windows"
    return None


def is_inside(text: str) -> bool:
    """Whether a relative path stays in its folder.  Both kinds of slash separate."""
    path = PureWindowsPath(text)
    return bool(path.parts) and not path.anchor and ".." not in path.parts


def invalid_output_reason(text: str) -> str | None:
    """Return why a pipeline may not choose a path in the run folder, or None."""
    parts = PureWindowsPath(text).parts
    if not is_inside(text):
        return "it is not inside"
    if parts[0].casefold() in RESERVED or parts[0].casefold().startswith(MODULE_FILE_PREFIX):
        return f"'{parts[0]}' is written by the run itself"
    if any(part.startswith(".") for part in parts):
        return "names with a dot in front are for temporary files"
    return next(filter(None, map(invalid_name_reason, parts)), None)


# Where commands may write their results: not over a file of a run.


def check_result_path(path: Path, suffix: str) -> None:
    """Raise ConfigError where a command would write a file of another kind, or over a file of a run."""
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{path}: expected the name of a file that ends in {suffix}")
    if path.name != COMPARISON:
        check_not_run_file(path)


def check_not_run_file(path: Path) -> None:
    """Raise ConfigError where a command would write over a file of a run."""
    folder = path.absolute().parent
    run = next(
        (one for one in (folder, *folder.parents) if any((one / n).is_file() for n in (CHECKSUMS, STATUS))), None
    )
    if run and path_exists(path) and _is_of(run, path):
        raise ConfigError(f"{path}: is a file of a run; give another name")


def _is_of(run: Path, path: Path) -> bool:
    """Whether a run has written a file of its folder: all but what its list of checksums does not know."""
    name = path.absolute().relative_to(run).as_posix()
    try:
        listed = read_json(run / CHECKSUMS)
    except DataError:  # it has not ended, or is a matrix
        return True
    return not isinstance(listed, dict) or name in listed or name in RESERVED
