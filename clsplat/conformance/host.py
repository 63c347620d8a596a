"""The host: its system, and the memory that is free."""

import os
import platform
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.core import machine
from clsplat.core.resources import full_version

CODE = ("PYOPENCL_BUILD", "POCL_", "CL_", "RUSTICL_", "LP_", "IGC_", "AMD_", "GPU_", "CUDA_")  # may change what runs
CACHES = ("POCL_CACHE", "CUDA_CACHE")  # do not
PREFIXES = (*CODE, "CLSPLAT_", "OCL_", "PYOPENCL_NO", "PYOPENCL_CTX", "OCLGRIND_")
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


def system() -> dict[str, Any]:
    """Return what a bug report needs of the host; of the environment only what concerns OpenCL."""
    return {
        "clsplat": full_version(),
        "system": platform.platform(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "memory_free": available_memory(),
        "environment": _variables(PREFIXES),
    }


def code_variables() -> dict[str, str]:
    """Return the variables with which compilers and runtimes may make other code of the same kernels."""
    found = _variables(CODE)
    return {name: value for name, value in found.items() if not name.startswith(CACHES) and name not in machine.LIMITS}


def _variables(prefixes: tuple[str, ...]) -> dict[str, str]:
    return {name: value for name, value in sorted(os.environ.items()) if name.startswith(prefixes)}
