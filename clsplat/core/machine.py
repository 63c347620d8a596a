"""This machine: the cache folder, cores, processes and their memory."""

import atexit
import ctypes
import logging
import os
import platform
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import platformdirs

from clsplat.core.errors import DataError, OutputError
from clsplat.core.reading import read_text

LOG = logging.getLogger("clsplat")
LIBRARIES = ("pyopencl", "pytools", "pocl")  # keep caches beside ours, and fail where they cannot


@cache
def cache_folder() -> Path:
    """Return the folder of clsplat's caches: it exists, can be written, and is the user's own.

    Where the user's caches cannot be written, as in a container without a home, they move below the temporary folder,
    those of the libraries too; a line says so.  Raises OutputError when that cannot be written either.
    """
    try:
        folders = [Path(platformdirs.user_cache_dir(name, name)) for name in ("clsplat", *LIBRARIES)]
    except RuntimeError:  # no HOME, and a user that the system does not know
        fault = "there is no home folder"
    else:
        fault = next(filter(None, map(_fault, [*folders, *user_cache_folders()])), "")
        if not fault:
            return folders[0]
    moved = _temporary()
    LOG.warning("%s; caches are in %s instead; XDG_CACHE_HOME can name a folder that lasts", fault, moved)
    os.environ["XDG_CACHE_HOME"] = str(moved)  # what all libraries read, in this process and those that it starts
    if user_cache_folders():
        os.environ["POCL_CACHE_DIR"] = str(moved / "pocl")
    ours = moved / "clsplat"
    if fault := _fault(ours):
        raise OutputError(f"{fault}; free its space, or let TMPDIR name a folder that can be written")
    return ours


def user_cache_folders() -> list[Path]:
    """The folder that PoCL was told to use, which stands before the folder of caches."""
    return [Path(os.environ["POCL_CACHE_DIR"])] if os.environ.get("POCL_CACHE_DIR") else []


def _fault(folder: Path) -> str:
    """Make a folder and try to write in it; return why that fails, or ''."""
    if not folder.is_absolute():  # of a HOME that is not
        return f"{folder}: is not an absolute path"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"clsplat")
    except OSError as error:
        return f"{folder}: cannot be written ({error.strerror or error})"
    return ""


def _temporary() -> Path:
    """A folder below the temporary one that nobody else can write: the same for all processes of a user, if possible.

    Raises OutputError when there is no temporary folder.
    """
    try:
        base = Path(tempfile.gettempdir())
        folder = base / f"clsplat-{os.getuid()}" if hasattr(os, "getuid") else base / "clsplat-caches"
        if not folder.is_symlink() and not folder.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
        if _private(folder):
            return folder
        folder = Path(tempfile.mkdtemp(prefix="clsplat-"))
    except OSError as error:
        raise OutputError(
            f"no folder for caches can be written ({error.strerror or error}); let XDG_CACHE_HOME or TMPDIR name one"
        ) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _private(folder: Path) -> bool:
    """Whether a folder belongs to this user and nobody else can write or read in it; systems without users: True."""
    if not hasattr(os, "getuid"):  # their temporary folder is the user's own
        return True
    state = folder.lstat()
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077


# The cores of this machine: which a process may use, and how another one is kept to some of them.

THREAD_VARIABLES = (  # variables by which a runtime is told how many threads to start
    "POCL_MAX_PTHREAD_COUNT",  # PoCL before 4
    "POCL_CPU_MAX_CU_COUNT",  # PoCL from 4 on
    "CL_CONFIG_CPU_TBB_NUM_WORKERS",  # Intel's
)
Cores = Sequence[int]  # numbers, as the system counts them


def usable_cores() -> tuple[int, ...]:
    """Return the cores that this process may use; where the system does not say, all of them."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def split_cores(cores: Cores, processes: int) -> list[tuple[int, ...]]:
    """Return the cores of each process: equal parts of neighbors, which share caches and memory.

    Cores that are left over belong to nobody, so that all processes have as many.
    """
    each = len(cores) // processes
    return [tuple(cores[number * each : (number + 1) * each]) for number in range(processes)]


def limited_environment(cores: Cores, variables: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the environment of a process that is kept to these cores: as many threads."""
    return {**variables, **dict.fromkeys(THREAD_VARIABLES, str(len(cores)))}


def pin_to_cores(cores: Cores, process: int = 0) -> None:
    """Keep a process, 0 this one, and what it starts from now on, to these cores, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        with suppress(OSError):  # it has ended, or a container has other cores by now
            os.sched_setaffinity(process, cores)


# Who runs: processes, where their numbers count, and whether they are alive, on every system.

FIRST_PID_NAMESPACE = "pid:[4026531836]"  # of Linux itself, outside of containers: PROC_PID_INIT_INO of its headers
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
QUERY_LIMITED_INFORMATION, STILL_ACTIVE, ACCESS_DENIED = 0x1000, 259, 5  # of Windows


@dataclass(frozen=True)
class Owner:
    """The process that holds or runs something: its number, and where that number counts."""

    process: int
    host: str  # name of the machine, or of the container
    pid_namespace: str | None  # of Linux, such as 'pid:[4026531836]'; containers on one machine have their own
    boot: str | None  # of Linux: another after each start of the machine, and the same in all its containers

    @classmethod
    def current(cls) -> "Owner":
        """Return this process."""
        return cls(os.getpid(), platform.node(), _pid_namespace(), _boot())

    @classmethod
    def from_record(cls, values: Mapping[str, Any]) -> "Owner | None":
        """Return the process that a file names, or None; what an older file does not say is as here."""
        process, this = values.get("process"), cls.current()
        if type(process) is not int or process <= 0:
            return None
        host, namespace = values.get("host", this.host), values.get("pid_namespace") or this.pid_namespace
        return cls(process, host, namespace, values.get("boot") or this.boot)

    @property
    def host_slug(self) -> str:
        """The host as a part of a file's name."""
        return re.sub(r"[^0-9A-Za-z-]", "_", self.host) or "host"

    @property
    def is_local(self) -> bool:
        """Whether its number counts here."""
        return replace(self, process=os.getpid()) == Owner.current()

    @property
    def has_ended(self) -> bool:
        """Whether it is known to have ended; of a process elsewhere that is not known.

        One of another boot has, where the host is a machine: containers of one name may be on two of them.
        """
        if self.is_local:
            return not is_alive(self.process)
        return (
            replace(self, boot=_boot()).is_local and self.pid_namespace == FIRST_PID_NAMESPACE and _boot() is not None
        )


def _pid_namespace() -> str | None:
    """Where process numbers count; None where the system does not say."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except (OSError, AttributeError):
        return None


def _boot() -> str | None:
    """Which start of the machine this is; None where the system does not say."""
    try:
        return read_text(BOOT_ID).strip() or None
    except DataError:
        return None


def is_alive(process: int) -> bool:
    """Return whether a process of this machine runs; True where the system does not say.

    A number may have been given to another process since.
    """
    if sys.platform == "win32":  # where os.kill(process, 0) would end it
        return _is_alive_on_windows(ctypes.WinDLL("kernel32", use_last_error=True), process)
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _is_alive_on_windows(kernel: Any, process: int) -> bool:
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = kernel.OpenProcess(QUERY_LIMITED_INFORMATION, False, process)
    if not handle:
        return bool(ctypes.get_last_error() == ACCESS_DENIED)  # type: ignore[attr-defined,unused-ignore]
    code = ctypes.c_ulong()
    known = kernel.GetExitCodeProcess(ctypes.c_void_p(handle), ctypes.byref(code))
    kernel.CloseHandle(ctypes.c_void_p(handle))
    return not known or code.value == STILL_ACTIVE


# The memory that is free.

CONTAINER = Path("/sys/fs/cgroup")


def available_memory() -> int | None:
    """Return the bytes that the host can give without swapping, within a container's limit; None: not known."""
    found: list[int] = []
    with suppress(OSError, ValueError):
        lines = Path("/proc/meminfo").read_text("utf-8").splitlines()
        found += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError, ValueError):  # where there is no container, or no limit ("max")
        found.append(
            int((CONTAINER / "memory.max").read_text("utf-8")) - int((CONTAINER / "memory.current").read_text("utf-8"))
        )
    if not found and hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        found.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return max(0, min(found)) if found else None
