"""Check the kernel caches of pyopencl and PoCL, and remove damaged entries."""

import logging
import os
import re
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import platformdirs

from clsplat.core.errors import DataError, OutputError
from clsplat.core.files import write_text
from clsplat.core.machine import LIBRARIES, Owner, cache_folder, process_limit, space_fault, user_cache_folders
from clsplat.core.reading import open_regular, read_text

LOG = logging.getLogger("clsplat")
SQLITE, SQLITE_HEADER = b"SQLite format 3\0", 100  # bytes
ELF, ELF_HEADER = b"\x7fELF", 64  # bytes, of the 64-bit format
MIN_FILE_SIZE = 2 << 20  # bytes; the largest built kernel needs about this
POCL_KERNEL = re.compile(r"[A-P]{2}/[A-P]{30,}/([^/]+)/\d+-\d+-\d+[^/]*/\1\.so")  # hash, kernel, group


def kernel_caches() -> str:
    """Return the paths of all folders of built kernels, joined for a message."""
    *other_folders, last = map(str, _kernel_folders())
    return f"{', '.join(other_folders)} and {last}"


def kernel_cache_advice() -> str:
    """Return advice for a device that works only with empty kernel caches."""
    if fault := _full_cache_fault():
        return fault
    return f"its cache of built kernels is damaged: remove {kernel_caches()}"


def require_space() -> None:
    """Raise OutputError if there may be no space for built kernels, because compilers then abort the process."""
    limit = process_limit("RLIMIT_FSIZE")
    if limit is not None and limit < MIN_FILE_SIZE:
        raise OutputError(
            f"`ulimit -f` limits files to {limit >> 10} KiB; kernels need {MIN_FILE_SIZE >> 10} KiB: raise the limit"
        )
    if fault := _full_cache_fault():
        raise OutputError(fault)


def _full_cache_fault() -> str:
    faults = filter(None, map(space_fault, (cache_folder(), *user_cache_folders())))
    return next((f"{fault}; free up space, or set XDG_CACHE_HOME to another folder" for fault in faults), "")


@cache
def remove_broken_kernels() -> None:
    """Remove files that a power failure truncated, because PoCL crashes when it loads such kernels.

    This runs once per boot if the system has a boot ID, else once per process.
    """
    state, record = f"{Owner.current().boot or ''}\n{kernel_caches()}", cache_folder() / "kernels_checked"
    with suppress(DataError):
        if not state.startswith("\n") and read_text(record) == state:
            return
    _, pytools, pocl = _kernel_folders()
    files = [file for file in _pocl_kernels(pocl) if _is_truncated(file)]
    files += [file for file in pytools.glob("pdict-*pyopencl*.sqlite") if not _is_database(file)]
    for file in files:
        with suppress(OSError):
            file.unlink()
    if files:
        LOG.warning("removed %d truncated files from the kernel cache (%s); they will be rebuilt", len(files), files[0])
    with suppress(OutputError):
        write_text(record, state)


def _pocl_kernels(folder: Path) -> list[Path]:
    """Return the kernels in a cache of PoCL, recognized by name: the folder may contain other files."""
    files = [(base, file) for base in (folder, folder / "kcache") for file in base.glob("[A-P][A-P]/*/*/*/*.so")]
    return [file for base, file in files if POCL_KERNEL.fullmatch(file.relative_to(base).as_posix())]


def _is_truncated(library: Path) -> bool:
    """Return whether a library is empty, not a library, or ends before its section table, which linkers write last."""
    try:
        with open_regular(library) as file:
            head, size = file.read(ELF_HEADER), file.seek(0, os.SEEK_END)
    except OSError:
        return False
    if head[:4] != ELF:
        return not head or sys.platform.startswith("linux")
    if len(head) < ELF_HEADER or head[4] != 2:  # 2: 64 bits
        return len(head) < ELF_HEADER
    order = "<" if head[5] == 1 else ">"
    (start,), (length, count) = struct.unpack_from(f"{order}Q", head, 40), struct.unpack_from(f"{order}2H", head, 58)
    return bool(start + length * count > size)


def _is_database(file: Path) -> bool:
    """Return whether a file is empty, or an SQLite database with all pages that its header states."""
    with suppress(OSError), open_regular(file) as stream:
        head = stream.read(SQLITE_HEADER)
        if len(head) < SQLITE_HEADER or not head.startswith(SQLITE):
            return not head
        page, changes, pages, valid_for = struct.unpack(">16xH6x2I60xI4x", head)
        if changes != valid_for or any(file.with_name(f"{file.name}-{end}").exists() for end in ("journal", "wal")):
            return True  # the page count is out of date, or another process is writing
        return bool(stream.seek(0, os.SEEK_END) >= pages * (65536 if page == 1 else page))
    return True


@contextmanager
def empty_kernel_caches() -> Iterator[dict[str, str]]:
    """Yield environment variables that make a child process use empty caches of built kernels."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield {"POCL_CACHE_DIR": folder, "PYOPENCL_NO_CACHE": "1"}


def _kernel_folders() -> list[Path]:
    pyopencl, pytools, pocl = (Path(platformdirs.user_cache_dir(name, name)) for name in LIBRARIES)
    return [pyopencl, pytools, next(iter(user_cache_folders()), pocl)]
