"""Write files atomically: a reader finds a complete file or no file, even after a power failure."""

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
# names of temporary files: .NAME.PID-NUMBER.partial
PARTIAL = re.compile(r"\..+\.(\d+)-\d+\.partial(\.\w+)?")
# error codes of systems that cannot sync a file or folder
NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF, errno.EACCES, errno.EPERM}
SYSTEM = os.name
_number = itertools.count()
_temporary_names: set[str] = set()  # names of the temporary files that this process is writing


@contextmanager
def open_atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file next to `path`; when the block ends without an error, sync it and rename it to `path`.

    The folder is synced afterwards, so that the new name survives a power failure.
    Raises OutputError when the file cannot be written; an existing file then stays unchanged.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic_path(path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a temporary path next to `path`, and rename it to `path` as `open_atomic` does.

    Use it with libraries that open files themselves and choose the format by the suffix.  The caller must sync the
    file.
    """
    if not path.name:
        raise OutputError(f"{path}: cannot be written (it has no file name); use the path of a file")
    temporary = _temporary_path(path, suffix)
    try:
        if path.exists() and not path.is_file():  # os.replace would replace a device too
            raise OutputError(f"{path}: cannot be written (not a regular file); use another name")
        make_folder(path.parent)
        yield temporary
        _replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise write_error(path, error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
        _temporary_names.discard(temporary.name)


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """Yield a hidden folder next to `folder`, and rename it to `folder` when the block ends without an error.

    Hidden folders left by killed processes are removed first.  The caller must sync the files.
    Raises ConfigError if `folder` exists and is not empty.  Raises OutputError, possibly before the block, if the
    folder cannot be created.
    """
    require_free(folder)
    with scratch_folder(folder) as temporary:
        yield temporary
        with raising_output_error(folder):
            if folder.exists():
                folder.rmdir()  # it is empty; os.replace cannot replace a folder on Windows
            _replace(temporary, folder)
            sync_folder(folder.parent)


@contextmanager
def scratch_folder(folder: Path) -> Iterator[Path]:
    """Yield a hidden folder next to `folder`, and remove it at the end of the block.

    Hidden folders left by killed processes are removed first.
    Raises OutputError before the block when the folder cannot be created.
    """
    temporary = _temporary_path(folder)
    try:
        with raising_output_error(folder):
            make_folder(folder.parent)
            temporary.mkdir()
            _remove_partial_folders(folder)
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        _temporary_names.discard(temporary.name)


def require_free(folder: Path) -> None:
    """Raise ConfigError if the path of a new folder exists, unless it is an empty folder."""
    with raising_output_error(folder):
        is_free = not path_exists(folder) or (folder.is_dir() and not any(folder.iterdir()))
    # os.replace cannot replace links and mount points
    if not (is_free and folder.name) or folder.is_symlink() or os.path.ismount(folder):
        raise ConfigError(f"{folder}: already exists; use a new folder")


@contextmanager
def raising_output_error(path: Path) -> Iterator[None]:
    """Convert an OSError in the block to an OutputError that names `path`."""
    try:
        yield
    except OSError as error:
        raise write_error(path, error) from error


def _temporary_path(path: Path, suffix: str = "") -> Path:
    """Return a hidden name next to `path` and register it as being written by this process."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{next(_number)}.partial{suffix}")
    _temporary_names.add(temporary.name)
    return temporary


def _replace(temporary: Path, path: Path) -> None:
    """Rename a file or folder; on Windows, retry for a second while another process is reading the old file."""
    for attempt in range(20):
        try:
            return os.replace(temporary, path)
        except PermissionError:
            if SYSTEM != "nt" or attempt == 19:
                raise
            time.sleep(0.05)


def append(path: Path, data: bytes) -> None:
    """Append to a file and sync it; if that fails, restore its old size.  Raises OutputError."""
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
    """Create a folder and its parents, and sync their directory entries to disk.  Raises OSError."""
    new_folders = list(itertools.takewhile(lambda path: not path.exists(), (folder, *folder.parents)))
    folder.mkdir(parents=True, exist_ok=True)
    for path in new_folders:
        sync_folder(path.parent)


def sync_below(folder: Path) -> None:
    """Sync all files below a folder, and their directory entries, to disk.  Links are skipped.  Raises OSError."""
    for base, _, names in os.walk(folder):
        for path in (Path(base, name) for name in names):
            if path.is_file() and not path.is_symlink():
                _sync(path, os.O_RDWR if SYSTEM == "nt" else os.O_RDONLY)  # Windows only syncs writable handles
        sync_folder(Path(base))


def sync_folder(folder: Path) -> None:
    """Sync the directory entries of a folder to disk, if the system supports that.  Raises OSError."""
    if hasattr(os, "O_DIRECTORY"):  # Windows syncs a directory entry with its file
        _sync(folder, os.O_RDONLY | os.O_DIRECTORY)


def _sync(path: Path, flags: int) -> None:
    try:
        descriptor = os.open(path, flags)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in NO_SYNC:
            raise


def remove_partial_files(folder: Path, marker: str) -> None:
    """Remove temporary files of killed processes below a folder, except in subfolders with a file named `marker`."""
    for base, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not os.path.exists(os.path.join(base, name, marker))]
        for name in filter(_is_abandoned, files):
            with suppress(OSError):
                os.unlink(os.path.join(base, name))
                LOG.debug("removed %s, left by a killed run", os.path.join(base, name))


def _remove_partial_folders(folder: Path) -> None:
    """Remove the temporary folders for `folder` that killed processes left behind."""
    with suppress(OSError):
        for path in folder.parent.iterdir():
            if path.name.startswith(f".{folder.name}.") and _is_abandoned(path.name):
                shutil.rmtree(path, ignore_errors=True)
                LOG.debug("removed %s, left by a killed process", path)


def _is_abandoned(name: str) -> bool:
    """Return whether a name is that of a temporary file or folder that no process on this machine writes anymore."""
    if not (match := PARTIAL.fullmatch(name)) or name in _temporary_names:
        return False
    pid = int(match[1])
    return pid == os.getpid() or not is_alive(pid)  # an earlier container may have had the same PID


def path_exists(path: Path) -> bool:
    """Return whether a path exists, even as a broken link.  Raises OutputError if that cannot be determined."""
    with raising_output_error(path):
        return path.exists() or path.is_symlink()


def write_error(path: Path, error: OSError) -> OutputError:
    """Return the OutputError for a file that cannot be written."""
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); check the folder and the free space")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically.  Raises OutputError."""
    with open_atomic(path) as file:
        file.write(text.encode())


# Portable file names, and names that are reserved in a run folder.

# The files that a run or a matrix writes in its folder.
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
STORE = "store"  # results of the cells of a matrix
MODULE_FILE_PREFIX = "view_"  # of files in which training modules store values for each view
RESERVED_NAMES = frozenset(
    {
        *(PIPELINE, METRICS, RECORDS, TRIAL, STATUS, LOG_FILE, PREPARE_SUMMARY, INPUTS, CHECKSUMS, LOCK),
        *(CHECKPOINTS, UNDISTORTED, PREPARED, COMPARISON, STORE, "cameras.json"),
    }
)
EARLY_RUN_FILES = frozenset({STATUS, LOG_FILE, LOCK, UNDISTORTED})  # written before pipeline.yaml
RUN_FILES = EARLY_RUN_FILES | {PIPELINE, METRICS, RECORDS, TRIAL, PREPARE_SUMMARY, INPUTS, CHECKSUMS, CHECKPOINTS}
MATRIX_FILES = frozenset({STATUS, LOCK, PIPELINE, COMPARISON, STORE})
END_STATES = ("done", "failed", "interrupted")  # states in status.json
HEARTBEAT_TIMEOUT = 60  # seconds; a run may have ended if its heartbeat in status.json is older
MAX_NAME_BYTES = 200  # systems allow 255, and temporary names are longer
_WINDOWS_NAMES = re.compile(r"(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[0-9¹²³])(\..*)?", re.IGNORECASE)  # devices


def invalid_name_reason(name: str) -> str | None:
    """Return the reason why a file name is not portable, or None if it is portable."""
    try:
        size = len(name.encode())
    except UnicodeEncodeError:
        return f"{name!r} is not valid Unicode"
    if size > MAX_NAME_BYTES:
        return f"a name of {size} bytes is too long; the limit is {MAX_NAME_BYTES}"
    if any(char < " " or char in '<>:"|?*\x7f' for char in name):
        return f"{name!r} contains a character that not every system allows"
    if _WINDOWS_NAMES.fullmatch(name.rstrip(" .")) or re.search(r"~\d", name) or name != name.rstrip(" ."):
        return f"'{name}' has a special meaning on Windows"
    return None


def is_inside(text: str) -> bool:
    """Return whether a path is relative and stays inside its folder.  Both `/` and `\\` are separators."""
    path = PureWindowsPath(text)
    return bool(path.parts) and not path.anchor and ".." not in path.parts


def invalid_output_reason(text: str) -> str | None:
    """Return why a pipeline may not write to a path in the run folder, or None if it may."""
    parts = PureWindowsPath(text).parts
    if not is_inside(text):
        return "it is outside of the run folder"
    if parts[0].casefold() in RESERVED_NAMES or parts[0].casefold().startswith(MODULE_FILE_PREFIX):
        return f"'{parts[0]}' is written by the run itself"
    if any(part.startswith(".") for part in parts):
        return "names that start with a dot are reserved for temporary files"
    return next(filter(None, map(invalid_name_reason, parts)), None)


# Commands may not overwrite files of a run with their results.


def check_result_path(path: Path, suffix: str) -> None:
    """Raise ConfigError if a result path has the wrong suffix or is a file of a run."""
    if path.suffix.lower() != suffix:
        raise ConfigError(f"{path}: use a file name that ends in {suffix}")
    if path.name != COMPARISON:
        check_not_run_file(path)


def check_not_run_file(path: Path) -> None:
    """Raise ConfigError if a command would overwrite a file of a run."""
    folders = path.absolute().parents
    run_folder = next((folder for folder in folders if any((folder / n).is_file() for n in (CHECKSUMS, STATUS))), None)
    if run_folder and path_exists(path) and _is_run_file(run_folder, path):
        raise ConfigError(f"{path}: is a file of a run; use another name")


def _is_run_file(run: Path, path: Path) -> bool:
    """Return whether a file in a run's folder belongs to the run; the checksums of a finished run list its files."""
    name = path.absolute().relative_to(run).as_posix()
    try:
        checksums = read_json(run / CHECKSUMS)
    except DataError:  # the run has not ended, or it is a matrix
        return True
    return not isinstance(checksums, dict) or name in checksums or name in RESERVED_NAMES
