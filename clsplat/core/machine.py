"""Query this machine: the cache folder, CPU cores, processes, and memory."""

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
from typing import Any, Literal

import platformdirs

from clsplat.core.errors import DataError, OutputError
from clsplat.core.reading import read_text

LOG = logging.getLogger("clsplat")
LIBRARIES = ("pyopencl", "pytools", "pocl")  # libraries that fail if they cannot write their caches
MIN_SPACE = 16 << 20  # bytes; the built kernels of a device take a few MB


@cache
def cache_folder() -> Path:
    """Return the cache folder of clsplat, which exists, is writable, and belongs to the user.

    The user's cache folders may not be writable, as in a container without a home, or may have little free space.  In
    these cases, all caches, including those of the libraries, move to the temporary folder, and a warning is logged: a
    compiler aborts the process when a built kernel does not fit.  Raises OutputError if the temporary folder is not
    writable either.
    """
    try:
        folders = [Path(platformdirs.user_cache_dir(name, name)) for name in ("clsplat", *LIBRARIES)]
    except RuntimeError:  # no HOME, and a user unknown to the system
        fault = "there is no home folder"
    else:
        folders += user_cache_folders()
        fault = next(filter(None, (_write_fault(folder) or space_fault(folder) for folder in folders)), "")
        if not fault:
            return folders[0]
    base = _temporary_cache_folder()
    LOG.warning("%s; using %s for caches instead; set XDG_CACHE_HOME to a permanent folder", fault, base)
    os.environ["XDG_CACHE_HOME"] = str(base)  # all libraries and child processes read it
    if user_cache_folders():
        os.environ["POCL_CACHE_DIR"] = str(base / "pocl")
    folder = base / "clsplat"
    if fault := _write_fault(folder):
        raise OutputError(f"{fault}; free up space, or set TMPDIR to a writable folder")
    return folder


def user_cache_folders() -> list[Path]:
    """Return a list with the folder in POCL_CACHE_DIR, which PoCL uses instead of its default; empty if not set."""
    return [Path(os.environ["POCL_CACHE_DIR"])] if os.environ.get("POCL_CACHE_DIR") else []


def _write_fault(folder: Path) -> str:
    """Create a folder and try to write in it; return the reason for a failure, or ''."""
    if not folder.is_absolute():  # if HOME is relative
        return f"{folder}: is not an absolute path"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"clsplat")
    except OSError as error:
        return f"{folder}: cannot be written ({error.strerror or error})"
    return ""


def space_fault(folder: Path) -> str:
    """Return the reason why built kernels may not fit in a folder, or '' if they fit."""
    with suppress(OSError, AttributeError):  # the free space is unknown
        if (free := shutil.disk_usage(folder).free) < MIN_SPACE:
            return f"{folder}: has only {free >> 10} KiB of free space, too little for built kernels"
    return ""


def _temporary_cache_folder() -> Path:
    """Return a private folder in the system's temporary folder, if possible the same for all processes of a user.

    Raises OutputError if there is no temporary folder.
    """
    try:
        base = Path(tempfile.gettempdir())
        folder = base / f"clsplat-{os.getuid()}" if hasattr(os, "getuid") else base / "clsplat-caches"
        if not folder.is_symlink() and not folder.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
        if _is_private(folder):
            return folder
        folder = Path(tempfile.mkdtemp(prefix="clsplat-"))
    except OSError as error:
        raise OutputError(
            f"no cache folder works ({error.strerror or error}); set XDG_CACHE_HOME or TMPDIR to a writable folder"
        ) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _is_private(folder: Path) -> bool:
    """Return whether only this user can read and write a folder; True on systems without user IDs."""
    if not hasattr(os, "getuid"):  # on Windows the temporary folder belongs to the user
        return True
    state = folder.lstat()
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077


# CPU cores that a process may use, and pinning processes to cores.

THREAD_VARIABLES = (  # environment variables that set the number of threads of a runtime
    "POCL_MAX_PTHREAD_COUNT",  # PoCL before 4
    "POCL_CPU_MAX_CU_COUNT",  # PoCL from 4 on
    "CL_CONFIG_CPU_TBB_NUM_WORKERS",  # Intel's runtime
)
Cores = Sequence[int]  # core numbers of the system


def usable_cores() -> tuple[int, ...]:
    """Return the cores that this process may use, or all cores if the system does not report them."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def split_cores(cores: Cores, processes: int) -> list[tuple[int, ...]]:
    """Split cores evenly into groups of adjacent cores, which share caches and memory.

    Leftover cores stay unused, so that all processes have the same number.
    """
    count = len(cores) // processes
    return [tuple(cores[i * count : (i + 1) * count]) for i in range(processes)]


def limited_environment(cores: Cores, variables: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return an environment that limits a process to one thread per core."""
    return {**variables, **dict.fromkeys(THREAD_VARIABLES, str(len(cores)))}


def pin_to_cores(cores: Cores, pid: int = 0) -> None:
    """Pin a process (0: this one) and its future children to these cores, if the system supports it."""
    if hasattr(os, "sched_setaffinity"):
        with suppress(OSError):  # the process has exited, or the container's cores have changed
            os.sched_setaffinity(pid, cores)


# Processes: their identity across hosts and containers, and whether they are running.

FIRST_PID_NAMESPACE = "pid:[4026531836]"  # the host's namespace, outside containers: PROC_PID_INIT_INO in Linux
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
QUERY_LIMITED_INFORMATION, STILL_ACTIVE, ACCESS_DENIED = 0x1000, 259, 5  # Windows constants


@dataclass(frozen=True)
class Owner:
    """A process that owns a folder or a run: its ID, and where that ID is valid."""

    process: int
    host: str  # name of the machine or container
    pid_namespace: str | None  # on Linux, such as 'pid:[4026531836]'; each container has its own
    boot: str | None  # boot ID on Linux, the same in all containers of a machine

    @classmethod
    def current(cls) -> "Owner":
        """Return this process."""
        return cls(os.getpid(), platform.node(), _pid_namespace(), _boot_id())

    @classmethod
    def from_record(cls, values: Mapping[str, Any]) -> "Owner | None":
        """Return the process in a record, or None.  Values that older records lack are taken from this process."""
        process, current = values.get("process"), cls.current()
        if type(process) is not int or process <= 0:
            return None
        host, namespace = values.get("host", current.host), values.get("pid_namespace") or current.pid_namespace
        return cls(process, host, namespace, values.get("boot") or current.boot)

    @property
    def host_slug(self) -> str:
        """The host's name, with characters that are unsafe in file names replaced by underscores."""
        return re.sub(r"[^0-9A-Za-z-]", "_", self.host) or "host"

    @property
    def is_local(self) -> bool:
        """Whether the process ID is valid on this host and in this container."""
        return replace(self, process=os.getpid()) == Owner.current()

    @property
    def has_ended(self) -> bool:
        """Whether the process is known to have exited; False for most processes on other hosts or in other containers.

        A process from an earlier boot of this machine has exited if it ran outside containers.  For a process inside a
        container this is unknown, because containers on two machines may share a name.
        """
        if self.is_local:
            return not is_alive(self.process)
        return (
            replace(self, boot=_boot_id()).is_local
            and self.pid_namespace == FIRST_PID_NAMESPACE
            and _boot_id() is not None
        )


def _pid_namespace() -> str | None:
    """Return the PID namespace, or None if unknown."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except (OSError, AttributeError):
        return None


def _boot_id() -> str | None:
    """Return the boot ID, or None if unknown."""
    try:
        return read_text(BOOT_ID).strip() or None
    except DataError:
        return None


def is_alive(pid: int) -> bool:
    """Return whether a process of this machine is running; True if unknown.

    A new process may have the ID of a process that has exited.
    """
    if sys.platform == "win32":  # os.kill(pid, 0) would end the process there
        return _is_alive_on_windows(ctypes.WinDLL("kernel32", use_last_error=True), pid)
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _is_alive_on_windows(kernel: Any, pid: int) -> bool:
    kernel.OpenProcess.restype = ctypes.c_void_p
    handle = kernel.OpenProcess(QUERY_LIMITED_INFORMATION, False, pid)
    if not handle:
        return bool(ctypes.get_last_error() == ACCESS_DENIED)  # type: ignore[attr-defined,unused-ignore]
    code = ctypes.c_ulong()
    succeeded = kernel.GetExitCodeProcess(ctypes.c_void_p(handle), ctypes.byref(code))
    kernel.CloseHandle(ctypes.c_void_p(handle))
    return not succeeded or code.value == STILL_ACTIVE


# Limits of a process, and free memory.


def process_limit(name: Literal["RLIMIT_AS", "RLIMIT_FSIZE"]) -> int | None:
    """Return the limit on the address space (`ulimit -v`) or on file sizes (`ulimit -f`) in bytes, or None."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit: int = resource.getrlimit(getattr(resource, name))[0]
    return None if limit == resource.RLIM_INFINITY else limit


CGROUP_FOLDER = Path("/sys/fs/cgroup")


def available_memory() -> int | None:
    """Return the free host memory in bytes, excluding swap space, within a container's limit; None if unknown."""
    limits: list[int] = []
    with suppress(OSError, ValueError):
        lines = Path("/proc/meminfo").read_text("utf-8").splitlines()
        limits += [int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError, ValueError):  # not in a container, or no limit ("max")
        limit, used = (int((CGROUP_FOLDER / f"memory.{name}").read_text("utf-8")) for name in ("max", "current"))
        limits.append(limit - used)
    if not limits and hasattr(os, "sysconf") and "SC_AVPHYS_PAGES" in os.sysconf_names:
        limits.append(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    return max(0, min(limits)) if limits else None
