"""Who runs: processes, where their numbers count, and whether they are alive, on every system."""

import ctypes
import os
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

QUERY_LIMITED_INFORMATION, STILL_ACTIVE, ACCESS_DENIED = 0x1000, 259, 5  # of Windows


@dataclass(frozen=True)
class Owner:
    """The process that holds or runs something: its number, and where that number counts."""

    process: int
    host: str  # name of the machine, or of the container
    pid_namespace: str | None  # of Linux, such as 'pid:[4026531836]'; containers on one machine have their own

    @classmethod
    def this(cls) -> "Owner":
        """Return this process."""
        return cls(os.getpid(), platform.node(), _pid_namespace())

    @classmethod
    def named_by(cls, values: Mapping[str, Any]) -> "Owner | None":
        """Return the process that a file names, or None; what an older file does not say is as here."""
        process, this = values.get("process"), cls.this()
        if type(process) is not int or process <= 0:
            return None
        return cls(process, values.get("host", this.host), values.get("pid_namespace") or this.pid_namespace)

    @property
    def is_here(self) -> bool:
        """Whether its number counts here."""
        this = Owner.this()
        return (self.host, self.pid_namespace) == (this.host, this.pid_namespace)

    @property
    def has_ended(self) -> bool:
        """Whether it is known to have ended; of a process elsewhere that is not known."""
        return self.is_here and not is_alive(self.process)


def _pid_namespace() -> str | None:
    """Where process numbers count; None where the system does not say."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except (OSError, AttributeError):
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
