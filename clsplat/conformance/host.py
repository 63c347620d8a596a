"""The host: its system, and the variables of the environment that concern OpenCL."""

import os
import platform
import sys
from typing import Any

import numpy as np

from clsplat.core import machine
from clsplat.core.machine import available_memory
from clsplat.core.resources import full_version

CODE = ("PYOPENCL_BUILD", "POCL_", "CL_", "RUSTICL_", "LP_", "IGC_", "AMD_", "GPU_", "CUDA_")  # may change what runs
CACHES = ("POCL_CACHE", "CUDA_CACHE")  # do not
PREFIXES = (*CODE, "CLSPLAT_", "OCL_", "PYOPENCL_NO", "PYOPENCL_CTX", "OCLGRIND_")


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
    return {
        name: value
        for name, value in found.items()
        if not name.startswith(CACHES) and name not in machine.THREAD_VARIABLES
    }


def _variables(prefixes: tuple[str, ...]) -> dict[str, str]:
    return {name: value for name, value in sorted(os.environ.items()) if name.startswith(prefixes)}
