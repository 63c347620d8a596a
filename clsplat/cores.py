"""The cores of this machine: which a process may use, and how another one is kept to some of them.

Runtimes take their number of threads from the environment where they read one, else from the cores that the system
lets the process use.
"""

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress

LIMITS = (  # variables by which a runtime is told how many threads to start
    "POCL_MAX_PTHREAD_COUNT",  # PoCL before 4
    "POCL_CPU_MAX_CU_COUNT",  # PoCL from 4 on
    "CL_CONFIG_CPU_TBB_NUM_WORKERS",  # Intel's
)
Cores = Sequence[int]  # numbers, as the system counts them


def usable() -> tuple[int, ...]:
    """Return the cores that this process may use; where the system does not say, all of them."""
    if hasattr(os, "sched_getaffinity"):
        return tuple(sorted(os.sched_getaffinity(0)))
    return tuple(range(os.cpu_count() or 1))


def packings(cores: int) -> list[int]:
    """Return the numbers of processes that so many cores are shared by: 1, 2, 4, … and one a core."""
    return sorted({1 << power for power in range(cores.bit_length()) if 1 << power <= cores} | {cores})


def shares(cores: Cores, processes: int) -> list[tuple[int, ...]]:
    """Return the cores of each process: equal parts of neighbours, which share caches and memory.

    Cores that are left over belong to nobody, so that all processes have as many.
    """
    each = len(cores) // processes
    return [tuple(cores[number * each : (number + 1) * each]) for number in range(processes)]


def limited(cores: Cores, variables: Mapping[str, str] = os.environ) -> dict[str, str]:
    """Return the environment of a process that is kept to these cores: as many threads."""
    return {**variables, **dict.fromkeys(LIMITS, str(len(cores)))}


def keep_to(cores: Cores, process: int = 0) -> None:
    """Keep a process, 0 this one, and what it starts from now on, to these cores, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        with suppress(OSError):  # it has ended, or a container has other cores by now
            os.sched_setaffinity(process, cores)
