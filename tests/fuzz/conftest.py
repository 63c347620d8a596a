"""Limits for readers: one more GiB of memory, and some seconds for a small file."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.timeouts import failing

BYTES = 1 << 30  # beyond what the process has


@pytest.fixture(autouse=True)
def bounded_memory() -> Iterator[None]:
    """Allocations beyond BYTES fail with a MemoryError, which is no refusal."""
    status = Path("/proc/self/status")
    if not status.is_file():
        yield
        return
    held = next(1024 * int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmSize:"))
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (held + BYTES, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture(autouse=True)
def alarm() -> Iterator[None]:
    """What `outcome` sets rings as an AssertionError."""
    with failing("the reader does not come to an end"):
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for the files of a module."""
    return tmp_path_factory.mktemp("fuzz")
