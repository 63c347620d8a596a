"""The kernels that pyopencl and PoCL keep built: where they are, and what to do where they are damaged."""

import logging
import os
import re
import shutil
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
from clsplat.core.machine import LIBRARIES, cache_folder, user_cache_folders
from clsplat.core.reading import open_regular, read_text

LOG = logging.getLogger("clsplat")
SQLITE, SQLITE_HEADER = b"SQLite format 3\0", 100  # bytes
ELF, ELF_HEADER = b"\x7fELF", 64  # bytes, of its 64-bit form
KERNEL_OF_POCL = re.compile(r"[A-P]{2}/[A-P]{30,}/([^/]+)/\d+-\d+-\d+[^/]*/\1\.so")  # hash, kernel, group
LEAST_SPACE = 2**20  # bytes; the built kernels of a device are some MB


def kernel_caches() -> str:
    """Return the folders that keep built kernels, in words."""
    *others, last = map(str, _kernel_folders())
    return f"{', '.join(others)} and {last}"


def damaged_kernels() -> str:
    """Say of a device that works with empty caches alone what to do."""
    if full := [folder for folder in _kernel_folders() if _is_full(folder)]:
        return f"{full[0]}: has no space for built kernels; free some, or let XDG_CACHE_HOME name another folder"
    return f"its cache of built kernels is damaged: remove {kernel_caches()}"


@cache
def remove_cut_kernels() -> None:
    """Remove what a loss of power has cut off: PoCL loads such kernels and ends the process.

    Once after each start of the machine, where the system tells one from another; else once in a process.
    """
    now, before = f"{_start_of_the_machine()}\n{kernel_caches()}", cache_folder() / "kernels_checked"
    with suppress(DataError):
        if not now.startswith("\n") and read_text(before) == now:
            return
    _, pytools, pocl = _kernel_folders()
    cut = [file for file in _kernels_of_pocl(pocl) if _is_cut(file)]
    cut += [file for file in pytools.glob("pdict-*pyopencl*.sqlite") if not _is_database(file)]
    for file in cut:
        with suppress(OSError):
            file.unlink()
    if cut:
        LOG.warning("%d files of built kernels are cut off (%s); they are removed, and made again", len(cut), cut[0])
    with suppress(OutputError):
        write_text(before, now)


def _start_of_the_machine() -> str:
    """What Linux names each start of the machine by; '' elsewhere."""
    with suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text("utf-8").strip()
    return ""


def _kernels_of_pocl(folder: Path) -> list[Path]:
    """The kernels in a cache of PoCL, by the names that it gives: the folder may hold files of others."""
    places = [(base, file) for base in (folder, folder / "kcache") for file in base.glob("[A-P][A-P]/*/*/*/*.so")]
    return [file for base, file in places if KERNEL_OF_POCL.fullmatch(file.relative_to(base).as_posix())]


def _is_cut(library: Path) -> bool:
    """Whether a library is empty, is none, or ends before its table of sections, which linkers write last."""
    try:
        with open_regular(library) as file:
            head, size = file.read(ELF_HEADER), file.seek(0, os.SEEK_END)
    except OSError:
        return False
    if head[:4] != ELF:
        return not head or sys.platform.startswith("linux")
    if len(head) < ELF_HEADER or head[4] != 2:  # of 32 bits
        return len(head) < ELF_HEADER
    order = "<" if head[5] == 1 else ">"
    (start,), (length, count) = struct.unpack_from(f"{order}Q", head, 40), struct.unpack_from(f"{order}2H", head, 58)
    return bool(start + length * count > size)


def _is_database(file: Path) -> bool:
    """Whether a file can be that of SQLite, with all pages that its header counts; an empty one is a new one."""
    with suppress(OSError), open_regular(file) as opened:
        head = opened.read(SQLITE_HEADER)
        if len(head) < SQLITE_HEADER or not head.startswith(SQLITE):
            return not head
        page, changes, pages, counted_at = struct.unpack(">16xH6x2I60xI4x", head)
        if changes != counted_at or any(file.with_name(f"{file.name}-{end}").exists() for end in ("journal", "wal")):
            return True  # the count is not kept up, or somebody writes: hence the size is looked at last
        return bool(opened.seek(0, os.SEEK_END) >= pages * (65536 if page == 1 else page))
    return True


@contextmanager
def empty_kernel_caches() -> Iterator[dict[str, str]]:
    """Yield the variables with which a process that starts in the block keeps built kernels in an empty folder."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield {"POCL_CACHE_DIR": folder, "PYOPENCL_NO_CACHE": "1"}


def _kernel_folders() -> list[Path]:
    pyopencl, pytools, pocl = (Path(platformdirs.user_cache_dir(name, name)) for name in LIBRARIES)
    return [pyopencl, pytools, next(iter(user_cache_folders()), pocl)]


def _is_full(folder: Path) -> bool:
    with suppress(OSError):
        return shutil.disk_usage(folder).free < LEAST_SPACE
    return False
