"""Lock folders, so that only one process at a time uses a folder.

The operating system releases a lock when its owner exits for any reason, so locks never become stale.  The file
`run.lock` names the owner.  On a file system without lock support, the process that creates this file owns the folder;
when that process has exited on this host, another process takes over the file.  Where locks are local to each machine,
as on some NFS and sshfs mounts, a run on another machine is detected by its heartbeat.
"""

import errno
import io
import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clsplat.core.errors import DataError, OutputError, shorten
from clsplat.core.files import END_STATES, HEARTBEAT_TIMEOUT, LOCK, STATUS, raising_output_error
from clsplat.core.machine import Owner
from clsplat.core.reading import read_json

# The owner of a folder, as recorded in the lock file, and error messages that name the owner.

LOG = logging.getLogger("clsplat")
LOCK_OFFSET = 1 << 20  # position of the locked byte; after the text, because Windows blocks reads of a locked byte


def owner_record() -> str:
    """Return the content of a lock file whose owner is this process, as JSON."""
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return json.dumps({**asdict(Owner.current()), "time": time.time(), "command": command})


def read_owner(file: io.FileIO) -> dict[str, Any]:
    """Return the owner's record in a lock file, or {} if the file is empty or damaged."""
    try:
        file.seek(0)
        owner = json.loads(file.read(LOCK_OFFSET))
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def require_stale_heartbeat(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Return the record of a lock file's owner if the owner is on another machine; otherwise return {}.

    A lock of another machine may be invisible here.  The owner's heartbeat, the time in the status file next to the
    lock file, then shows whether the owner is running.  Machines may share a name, so boot IDs are compared where both
    are known.  Raises OutputError if the heartbeat is recent.
    """
    record = read_owner(file)
    owner, local = Owner.from_record(record), Owner.current()
    if owner is None or (owner.boot == local.boot if record.get("boot") and local.boot else owner.host == local.host):
        return {}
    heartbeat = _heartbeat(path)
    if heartbeat is not None and (age := time.time() - heartbeat) < HEARTBEAT_TIMEOUT:
        raise OutputError(
            f"{in_use_message(folder, record)}; the last heartbeat of that process was {max(0, age):.0f} s ago; "
            f"if the process has exited, wait a minute or remove {path}"
        )
    return record


def wait_for_stale_heartbeat(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Wait until the owner's heartbeat is stale, and return the owner's record, as `require_stale_heartbeat` does.

    The clocks of two machines may differ, so a recent heartbeat alone proves nothing: the owner is running if its
    heartbeat changes during the wait.  Raises OutputError in that case.
    """
    heartbeat, deadline, is_logged = _heartbeat(path), time.monotonic() + HEARTBEAT_TIMEOUT, False
    while True:
        try:
            return require_stale_heartbeat(file, path, folder)
        except OutputError:
            if _heartbeat(path) != heartbeat:
                raise
            if time.monotonic() >= deadline:
                return read_owner(file)
            if not is_logged:
                is_logged = True
                LOG.info(
                    "%s: was recently in use on another machine; waiting up to a minute for a heartbeat from there",
                    folder,
                )
        time.sleep(1)


def _heartbeat(path: Path) -> float | None:
    """Return the time of a run's last status, in seconds since 1970; None if the run has no status or has ended.

    The status file is in the folder of the lock file, `path`.
    """
    with suppress(DataError, AttributeError, KeyError, TypeError, ValueError):
        status = read_json(path.with_name(STATUS), limit=LOCK_OFFSET)
        return None if status.get("state") in END_STATES else float(status["time"])
    return None


def lost_lock_message(path: Path, folder: Path) -> str:
    """Return the message about a lock file that was removed or replaced."""
    try:
        owner = read_json(path, limit=LOCK_OFFSET)
        holder = f", and process {owner['process']} on {owner['host']} holds it now"
    except (DataError, KeyError, TypeError):
        holder = ""
    return (
        f"{folder}: {path.name} was removed or replaced while this process held it{holder}; nothing more was written; "
        "resume the run when no other process uses the folder"
    )


def in_use_message(folder: Path, owner: dict[str, Any]) -> str:
    """Return the message about a folder that another process uses."""
    if not owner:
        return f"{folder}: is in use by another process; wait for it, or use another folder"
    try:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(owner.get("time", 0))))
    except (TypeError, ValueError, OverflowError, OSError):
        since = "an unknown time"
    return (
        f"{folder}: is in use by process {owner.get('process')} on {owner.get('host')} since {since} "
        f"({shorten(str(owner.get('command')))}); wait for it, or use another folder"
    )


LOCK_TAKEN = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # error codes for a lock that another process holds
# error codes of a file system without lock support
NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}
_locked_files: set[Path] = set()  # lock files that this process holds or is locking
_locked_files_lock = threading.Lock()


@contextmanager
def lock_folder(folder: Path, path: Path | None = None) -> Iterator[Callable[[], None]]:
    """Lock a folder during the block.  The lock file is `path`, by default `run.lock` in the folder.

    Yields a function that raises OutputError if the lock file was removed or replaced, because another process may then
    use the folder.  Raises OutputError, with the owner's process ID and host, if another process holds the lock.
    """
    path = _resolve(folder, path or folder / LOCK)
    with _reserve(path, folder):
        with raising_output_error(path):
            file = _acquire(path, folder)

        def require_lock() -> None:
            with suppress(OSError):  # if the folder is unreadable, the next write reports it
                if not file.closed and not _is_still_at(file, path):
                    raise OutputError(lost_lock_message(path, folder))

        try:
            yield require_lock
        finally:
            with suppress(OSError):  # Windows cannot remove an open file
                if _is_still_at(file, path):
                    path.unlink()
            file.close()
            with suppress(OSError):
                if os.name == "nt":
                    path.unlink()


@contextmanager
def _reserve(path: Path, folder: Path) -> Iterator[None]:
    """Reserve a lock file for this thread during the block.  Raises OutputError if another thread holds it."""
    with _locked_files_lock:
        _require_not_held(path, folder)
        _locked_files.add(path)
    try:
        yield
    finally:
        _locked_files.discard(path)


def check_free(folder: Path) -> bool:
    """Raise OutputError if `lock_folder` would fail immediately.  Write no files.

    Returns False if `lock_folder` would wait for the heartbeat of a run on another machine, otherwise True.
    """
    path = _resolve(folder, folder / LOCK)
    with raising_output_error(path), suppress(FileNotFoundError), path.open("r+b", buffering=0) as file:
        try:
            if not _system_lock(file):
                raise OutputError(in_use_message(folder, read_owner(file)))
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            _require_exited_owner(file, path, folder)
            return True
        try:
            require_stale_heartbeat(file, path, folder)
        except OutputError:
            return False
    return True


def _resolve(folder: Path, file: Path) -> Path:
    """Return the canonical path of a lock file.  Raises OutputError for a link, or if this process holds the lock."""
    path = file.parent.resolve() / file.name
    _require_not_held(path, folder)
    if path.is_symlink():
        raise OutputError(f"{file}: is a symbolic link instead of a regular file; remove it")
    return path


def _require_not_held(path: Path, folder: Path) -> None:
    if path in _locked_files:
        raise OutputError(
            f"{folder}: is in use by this process; close the run or trainer that uses it, or use another folder"
        )


def _acquire(path: Path, folder: Path) -> io.FileIO:
    """Open and lock a lock file, and record this process as its owner.  Raises OutputError or OSError."""
    while True:
        file, is_new = _open_lock_file(path)
        if file is None:
            continue
        try:
            if _take_ownership(file, is_new, path, folder):
                file.seek(0)
                file.truncate()
                file.write(owner_record().encode())
                return file
        except BaseException:
            file.close()
            raise
        file.close()


def _open_lock_file(path: Path) -> tuple[io.FileIO | None, bool]:
    """Return an open lock file (None if its owner is removing it), and whether this process created it."""
    with suppress(FileExistsError):
        return path.open("x+b", buffering=0), True
    with suppress(FileNotFoundError):
        return path.open("r+b", buffering=0), False
    return None, False


def _take_ownership(file: io.FileIO, is_new: bool, path: Path, folder: Path) -> bool:
    """Lock the file and return True, or return False if the file is no longer at its path.

    Without lock support, the process that created the file owns it.
    """
    try:
        if not _system_lock(file):
            raise OutputError(in_use_message(folder, read_owner(file)))
        if not _is_still_at(file, path):
            return False
        if not is_new and (owner := wait_for_stale_heartbeat(file, path, folder)):
            LOG.info("%s: taken over from process %s on %s", folder, owner.get("process"), owner.get("host"))
            with suppress(PermissionError):  # Windows cannot rename an open file
                _remove(file, path)  # so that the previous owner, if it is still running, notices
                return False
        return True
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    if not is_new:
        owner = _require_exited_owner(file, path, folder)
        LOG.info("%s: taken over from process %s, which has exited", folder, owner.get("process"))
        _remove(file, path)
        return False
    LOG.warning("%s: the file system does not support locks; do not delete %s during the run", folder, path.name)
    return True


def _require_exited_owner(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Return the owner of a folder on a file system without locks.  Raises OutputError unless the owner has exited."""
    owner = read_owner(file)
    if not _has_exited(Owner.from_record(owner)):
        raise OutputError(
            f"{in_use_message(folder, owner)}; this file system does not support locks: "
            f"if that process has exited, remove {path}"
        )
    return owner


def _remove(file: io.FileIO, path: Path) -> None:
    """Remove an open file from its path, but not a newer file at the same path."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}-0.partial")  # cleaned up later if this process is killed
    with suppress(FileNotFoundError):
        os.replace(path, temporary)
        if _is_still_at(file, temporary):
            temporary.unlink()
        else:
            with suppress(FileExistsError):  # a third process has created a new lock file
                os.link(temporary, path)
            temporary.unlink()


def _system_lock(file: io.FileIO) -> bool:
    """Lock an open file; return False if another process holds the lock.  Raises OSError if locks are unsupported."""
    try:
        if os.name == "nt":
            import msvcrt

            file.seek(LOCK_OFFSET)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
        else:
            import fcntl

            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError as error:
        raise OSError(errno.ENOSYS, "no locks") from error
    except OSError as error:
        if error.errno not in LOCK_TAKEN:
            raise
        return False
    return True


def _is_still_at(file: io.FileIO, path: Path) -> bool:
    """Return whether an open file is still the file at a path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def _has_exited(owner: Owner | None) -> bool:
    # an owner that equals this process is an earlier process with the same ID, since `_resolve` rejects our own locks
    return owner is not None and (owner == Owner.current() or owner.has_ended)
