"""One process at a time in a folder.

The system releases the lock when its holder ends, however it ends, so that it is never left behind.  The file
`run.lock` tells who holds it.  Where a file system knows no locks, whoever makes that file holds the folder; one whose
process has ended on this host is taken over.  Where locks count on each machine alone, as some mounts of NFS and sshfs
have them, a run on another machine is noticed by its heartbeat.
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

# Who holds a folder: what the file of its lock says, and what is told of it.

LOG = logging.getLogger("clsplat")
LOCK_OFFSET = 1 << 20  # bytes: Windows locks a byte for readers too, and this one is not read


def owner_record() -> str:
    """What the file says of this process."""
    command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
    return json.dumps({**asdict(Owner.current()), "time": time.time(), "command": command})


def read_owner(file: io.FileIO) -> dict[str, Any]:
    """Who the file names; nobody where it is empty or damaged."""
    try:
        file.seek(0)
        owner = json.loads(file.read(LOCK_OFFSET))
    except (OSError, ValueError, RecursionError):
        return {}
    return owner if isinstance(owner, dict) else {}


def require_stale_heartbeat(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Who the file names, where that is a process of another machine, whose locks may not reach this one; else {}.

    Machines may have the same name: where the systems say which start they are of, that counts.
    Raises OutputError where the run's status beside the file shows that it goes on.
    """
    owner = read_owner(file)
    named, this = Owner.from_record(owner), Owner.current()
    if named is None or (named.boot == this.boot if owner.get("boot") and this.boot else named.host == this.host):
        return {}
    beat = _heartbeat(path)
    if beat is not None and (silent := time.time() - beat) < HEARTBEAT_TIMEOUT:
        raise OutputError(
            f"{in_use_message(folder, owner)}; its heartbeat is {max(0, silent):.0f} s old, though the lock is free here: "
            f"if that process has ended, wait for a minute, or remove {path}"
        )
    return owner


def wait_for_stale_heartbeat(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Do as `require_stale_heartbeat`, but wait for the next heartbeat: where none comes in time, the process has ended.

    That it comes counts, not its time: the clocks of two machines may differ.
    """
    beat, end, told = _heartbeat(path), time.monotonic() + HEARTBEAT_TIMEOUT, False
    while True:
        try:
            return require_stale_heartbeat(file, path, folder)
        except OutputError:
            if _heartbeat(path) != beat:
                raise
            if time.monotonic() >= end:
                return read_owner(file)
            if not told:
                told = True
                LOG.info("%s: was in use elsewhere just now; waiting for its heartbeat, a minute at most", folder)
        time.sleep(1)


def _heartbeat(path: Path) -> float | None:
    """When the status beside a lock was written, in seconds since 1970; None where there is none, or the run ended."""
    with suppress(DataError, AttributeError, KeyError, TypeError, ValueError):
        status = read_json(path.with_name(STATUS), limit=LOCK_OFFSET)
        return None if status.get("state") in END_STATES else float(status["time"])
    return None


def lost_lock_message(path: Path, folder: Path) -> str:
    """What to tell of a lock whose file is no longer at its path."""
    try:
        owner = read_json(path, limit=LOCK_OFFSET)
        by = f", and process {owner['process']} on {owner['host']} holds it now"
    except (DataError, KeyError, TypeError):
        by = ""
    return (
        f"{folder}: {path.name} was removed or replaced while this process held it{by}; nothing more was written; "
        "to go on, resume the run when no other process uses it"
    )


def in_use_message(folder: Path, owner: dict[str, Any]) -> str:
    if not owner:
        return f"{folder}: is in use by another process"
    try:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(float(owner.get("time", 0))))
    except (TypeError, ValueError, OverflowError, OSError):
        since = "an unknown time"
    return (
        f"{folder}: is in use by process {owner.get('process')} on {owner.get('host')} since {since} "
        f"({shorten(str(owner.get('command')))}); wait for it, or give another folder"
    )


LOCK_TAKEN = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}  # what the systems answer for a lock that another holds
NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}
_held: set[Path] = set()  # by this process, or being locked by it
_reserving = threading.Lock()


@contextmanager
def lock_folder(folder: Path, path: Path | None = None) -> Iterator[Callable[[], None]]:
    """Hold the lock of a folder in the block: a file `path`, by default `run.lock` in it.

    Yields a function that raises OutputError where that file was removed or replaced, so that another may hold the
    folder.  Raises OutputError, with process and host where another holds it.
    """
    path = _path(folder, path or folder / LOCK)
    with _reserved(path, folder):
        with raising_output_error(path):
            file = _locked(path, folder)

        def require_held() -> None:
            with suppress(OSError):  # whoever writes there is told of that
                if not file.closed and not _is_at(file, path):
                    raise OutputError(lost_lock_message(path, folder))

        try:
            yield require_held
        finally:
            with suppress(OSError):  # Windows removes no open file
                if _is_at(file, path):
                    path.unlink()
            file.close()
            with suppress(OSError):
                if os.name == "nt":
                    path.unlink()


@contextmanager
def _reserved(path: Path, folder: Path) -> Iterator[None]:
    """Keep other threads of this process away.  Raises OutputError."""
    with _reserving:
        _require_not_held(path, folder)
        _held.add(path)
    try:
        yield
    finally:
        _held.discard(path)


def check_free(folder: Path) -> bool:
    """Raise OutputError where `lock_folder` would at once; nothing is written.

    Returns False where `lock_folder` would wait for the heartbeat of a run on another machine.
    """
    path = _path(folder, folder / LOCK)
    with raising_output_error(path), suppress(FileNotFoundError), path.open("r+b", buffering=0) as file:
        try:
            if not _system_lock(file):
                raise OutputError(in_use_message(folder, read_owner(file)))
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            _ended_owner(file, path, folder)
            return True
        try:
            require_stale_heartbeat(file, path, folder)
        except OutputError:
            return False
    return True


def _path(folder: Path, file: Path) -> Path:
    """The one path of a lock's file that this process does not hold.  Raises OutputError."""
    path = file.parent.resolve() / file.name
    _require_not_held(path, folder)
    if path.is_symlink():
        raise OutputError(f"{file}: is a link, which is not followed; remove it")
    return path


def _require_not_held(path: Path, folder: Path) -> None:
    if path in _held:
        raise OutputError(f"{folder}: is in use by this process; end that run or trainer first, or give another folder")


def _locked(path: Path, folder: Path) -> io.FileIO:
    """Open the file and lock it; write into it who holds it.  Raises OutputError and OSError."""
    while True:
        file, is_new = _opened(path)
        if file is None:
            continue
        try:
            if _is_ours(file, is_new, path, folder):
                file.seek(0)
                file.truncate()
                file.write(owner_record().encode())
                return file
        except BaseException:
            file.close()
            raise
        file.close()


def _opened(path: Path) -> tuple[io.FileIO | None, bool]:
    """Open the file, and tell whether this process made it; None where its holder removes it just now."""
    with suppress(FileExistsError):
        return path.open("x+b", buffering=0), True
    with suppress(FileNotFoundError):
        return path.open("r+b", buffering=0), False
    return None, False


def _is_ours(file: io.FileIO, is_new: bool, path: Path, folder: Path) -> bool:
    """Lock the file; False where it is no longer the one at its path.  Where there are no locks, its maker holds it."""
    try:
        if not _system_lock(file):
            raise OutputError(in_use_message(folder, read_owner(file)))
        if not _is_at(file, path):
            return False
        if not is_new and (owner := wait_for_stale_heartbeat(file, path, folder)):
            LOG.info("%s: taken over from process %s on %s", folder, owner.get("process"), owner.get("host"))
            with suppress(PermissionError):  # Windows renames no open file
                _remove(file, path)  # so that the one before notices, where it goes on after all
                return False
        return True
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
    if not is_new:
        owner = _ended_owner(file, path, folder)
        LOG.info("%s: taken over from process %s, which has ended", folder, owner.get("process"))
        _remove(file, path)
        return False
    LOG.warning("%s: its file system knows no locks; %s alone keeps other processes away", folder, path.name)
    return True


def _ended_owner(file: io.FileIO, path: Path, folder: Path) -> dict[str, Any]:
    """Who the file names, where there are no locks.  Raises OutputError unless that process has ended."""
    owner = read_owner(file)
    if not _has_ended(Owner.from_record(owner)):
        raise OutputError(
            f"{in_use_message(folder, owner)}; this file system knows no locks: if that process has ended, remove {path}"
        )
    return owner


def _remove(file: io.FileIO, path: Path) -> None:
    """Remove an open file from its path, but not another that was made there since."""
    aside = path.with_name(f".{path.name}.{os.getpid()}-0.partial")  # swept where this process is killed
    with suppress(FileNotFoundError):
        os.replace(path, aside)
        if _is_at(file, aside):
            aside.unlink()
        else:
            with suppress(FileExistsError):  # where a third process has made one since
                os.link(aside, path)
            aside.unlink()


def _system_lock(file: io.FileIO) -> bool:
    """Lock an open file; return False where another holds the lock.  Raises OSError where there are no locks."""
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


def _is_at(file: io.FileIO, path: Path) -> bool:
    """Whether an open file is still the one at a path."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except (FileNotFoundError, NotADirectoryError):
        return False


def _has_ended(owner: Owner | None) -> bool:
    return owner is not None and (owner == Owner.current() or owner.has_ended)  # this process does not hold it
