"""Who runs: processes, where their numbers count, and whether they are alive, on every system."""

import ctypes
import os
import platform
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.errors import DataError
from clsplat.reading import read_text

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
    def this(cls) -> "Owner":
        """Return this process."""
        return cls(os.getpid(), platform.node(), _pid_namespace(), _boot())

    @classmethod
    def named_by(cls, values: Mapping[str, Any]) -> "Owner | None":
        """Return the process that a file names, or None; what an older file does not say is as here."""
        process, this = values.get("process"), cls.this()
        if type(process) is not int or process <= 0:
            return None
        host, namespace = values.get("host", this.host), values.get("pid_namespace") or this.pid_namespace
        return cls(process, host, namespace, values.get("boot") or this.boot)

    @property
    def host_word(self) -> str:
        """The host as a part of a file's name."""
        return re.sub(r"[^0-9A-Za-z-]", "_", self.host) or "host"

    @property
    def is_here(self) -> bool:
        """Whether its number counts here."""
        return replace(self, process=os.getpid()) == Owner.this()

    @property
    def has_ended(self) -> bool:
        """Whether it is known to have ended; of a process elsewhere that is not known.

        One of another boot has, where the host is a machine: containers of one name may be on two of them.
        """
        if self.is_here:
            return not is_alive(self.process)
        return replace(self, boot=_boot()).is_here and self.pid_namespace == FIRST_PID_NAMESPACE and _boot() is not None


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


def peak_memory() -> int | None:
    """Return the bytes that this process has held at most; None where the system does not say."""
    try:
        lines = read_text(Path("/proc/self/status")).splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))
    except (DataError, StopIteration):
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
