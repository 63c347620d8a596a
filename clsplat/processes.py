"""Whether a process runs, on every system."""

import ctypes
import os
import sys
from typing import Any

QUERY_LIMITED_INFORMATION, STILL_ACTIVE, ACCESS_DENIED = 0x1000, 259, 5  # of Windows


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
