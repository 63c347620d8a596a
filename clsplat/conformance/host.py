"""Describe the host: its system, and the environment variables of OpenCL runtimes."""

import os
import platform
import sys
from typing import Any

import numpy as np

from clsplat.core import machine
from clsplat.core.machine import available_memory
from clsplat.core.resources import full_version

CODE = ("PYOPENCL_BUILD", "POCL_", "CL_", "RUSTICL_", "LP_", "IGC_", "AMD_", "GPU_", "CUDA_")  # may change kernels
CACHES = ("POCL_CACHE", "CUDA_CACHE")  # do not change kernels
PREFIXES = (*CODE, "CLSPLAT_", "OCL_", "PYOPENCL_NO", "PYOPENCL_CTX", "OCLGRIND_")


def describe_host() -> dict[str, Any]:
    """Describe the host for a bug report, with only the environment variables of OpenCL runtimes."""
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
    """Return the environment variables that may change how compilers and runtimes build kernels."""
    ignored_prefixes = (*CACHES, *machine.THREAD_VARIABLES)
    return {name: value for name, value in _variables(CODE).items() if not name.startswith(ignored_prefixes)}


def _variables(prefixes: tuple[str, ...]) -> dict[str, str]:
    return {name: value for name, value in sorted(os.environ.items()) if name.startswith(prefixes)}
