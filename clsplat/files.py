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
from pathlib import Path
from typing import BinaryIO

from clsplat.errors import ConfigError, OutputError
from clsplat.processes import is_alive

LOG = logging.getLogger("clsplat")
# what a process that was killed leaves: .NAME.PROCESS-NUMBER.partial
PARTIAL = re.compile(r"\..+\.(\d+)-\d+\.partial(\.\w+)?")
NO_SYNC = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF, errno.EACCES, errno.EPERM}
SYSTEM = os.name
_number = itertools.count()
_open: set[str] = set()  # names of the temporary files that this process writes


@contextmanager
def atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; when the block ends without an error, sync it and rename it to `path`.

    Then the folder is synced, so that the new name outlasts a power cut.
    Raises OutputError with the file's name when it cannot be written; an earlier file then stays unchanged.
    """
    with atomic_name(path) as temporary, temporary.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def atomic_name(path: Path, suffix: str = "") -> Iterator[Path]:
    """Yield a temporary name beside `path` for what opens files itself and looks at their suffix; then as `atomic`.

    Who takes the name syncs the file.
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
        raise unwritable(path, error) from error
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
        with told_as(folder):
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
        with told_as(folder):
            make_folder(folder.parent)
            temporary.mkdir()
            _sweep_beside(folder)
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        _open.discard(temporary.name)


def require_free(folder: Path) -> None:
    """Raise ConfigError where something but an empty folder lies at the place of a new one."""
    with told_as(folder):
        is_free = not is_there(folder) or (folder.is_dir() and not any(folder.iterdir()))
    if not (is_free and folder.name) or folder.is_symlink() or os.path.ismount(folder):  # which a rename cannot replace
        raise ConfigError(f"{folder}: is in use; give the name of a new folder")


@contextmanager
def told_as(path: Path) -> Iterator[None]:
    """Raise OutputError, with the name of what cannot be written, for an OSError of the block."""
    try:
        yield
    except OSError as error:
        raise unwritable(path, error) from error


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
    with told_as(path):
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


def sweep(folder: Path, border: str) -> None:
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


def is_there(path: Path) -> bool:
    """Return whether something lies where a file or folder is to be made.  Raises OutputError where nothing can."""
    with told_as(path):
        return path.exists() or path.is_symlink()


def unwritable(path: Path, error: OSError) -> OutputError:
    """Return the OutputError for a file that cannot be written."""
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); check the folder and its space")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically.  Raises OutputError."""
    with atomic(path) as file:
        file.write(text.encode())
