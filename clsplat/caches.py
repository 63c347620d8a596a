"""The folder of what may be lost: kernels that were built, runtimes that were tested."""

import atexit
import logging
import os
import re
import shutil
import stat
import struct
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import platformdirs

from clsplat.errors import OutputError
from clsplat.reading import regular

LOG = logging.getLogger("clsplat")
LIBRARIES = ("pyopencl", "pytools", "pocl")  # keep caches beside ours, and fail where they cannot
SQLITE, SQLITE_HEADER = b"SQLite format 3\0", 100  # bytes
ELF, ELF_HEADER = b"\x7fELF", 64  # bytes, of its 64-bit form
KERNEL_OF_POCL = re.compile(r"[A-P]{2}/[A-P]{30,}/([^/]+)/\d+-\d+-\d+[^/]*/\1\.so")  # hash, kernel, group
LEAST_SPACE = 2**20  # bytes; the built kernels of a device are some MB


@cache
def cache_folder() -> Path:
    """Return the folder of clsplat's caches: it exists, can be written, and is the user's own.

    Where the user's caches cannot be written, as in a container without a home, they move below the temporary folder,
    those of the libraries too; a line says so.  Raises OutputError when that cannot be written either.
    """
    try:
        folders = [Path(platformdirs.user_cache_dir(name, name)) for name in ("clsplat", *LIBRARIES)]
    except RuntimeError:  # no HOME, and a user that the system does not know
        fault = "there is no home folder"
    else:
        fault = next(filter(None, map(_fault, [*folders, *_named_by_user()])), "")
        if not fault:
            return folders[0]
    moved = _temporary()
    LOG.warning("%s; caches are in %s instead; XDG_CACHE_HOME can name a folder that lasts", fault, moved)
    os.environ["XDG_CACHE_HOME"] = str(moved)  # what all libraries read, in this process and those that it starts
    if _named_by_user():
        os.environ["POCL_CACHE_DIR"] = str(moved / "pocl")
    ours = moved / "clsplat"
    if fault := _fault(ours):
        raise OutputError(f"{fault}; free its space, or let TMPDIR name a folder that can be written")
    return ours


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
    """Remove, once in a process, what a loss of power has cut off: PoCL loads such kernels and ends the process."""
    _, pytools, pocl = _kernel_folders()
    cut = [file for file in _kernels_of_pocl(pocl) if _is_cut(file)]
    cut += [file for file in pytools.glob("pdict-*pyopencl*.sqlite") if not _is_database(file)]
    for file in cut:
        with suppress(OSError):
            file.unlink()
    if cut:
        LOG.warning("%d files of built kernels are cut off (%s); they are removed, and made again", len(cut), cut[0])


def _kernels_of_pocl(folder: Path) -> list[Path]:
    """The kernels in a cache of PoCL, by the names that it gives: the folder may hold files of others."""
    places = [(base, file) for base in (folder, folder / "kcache") for file in base.glob("[A-P][A-P]/*/*/*/*.so")]
    return [file for base, file in places if KERNEL_OF_POCL.fullmatch(file.relative_to(base).as_posix())]


def _is_cut(library: Path) -> bool:
    """Whether a library is empty, is none, or ends before its table of sections, which linkers write last."""
    try:
        with regular(library) as file:
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
    with suppress(OSError), regular(file) as opened:
        head = opened.read(SQLITE_HEADER)
        if len(head) < SQLITE_HEADER or not head.startswith(SQLITE):
            return not head
        page, changes, pages, counted_at = struct.unpack(">16xH6x2I60xI4x", head)
        if changes != counted_at or any(file.with_name(f"{file.name}-{end}").exists() for end in ("journal", "wal")):
            return True  # the count is not kept up, or somebody writes: hence the size is looked at last
        return opened.seek(0, os.SEEK_END) >= pages * (65536 if page == 1 else page)
    return True


@contextmanager
def empty_kernel_caches() -> Iterator[dict[str, str]]:
    """Yield the variables with which a process that starts in the block keeps built kernels in an empty folder."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield {"POCL_CACHE_DIR": folder, "PYOPENCL_NO_CACHE": "1"}


def _kernel_folders() -> list[Path]:
    pyopencl, pytools, pocl = (Path(platformdirs.user_cache_dir(name, name)) for name in LIBRARIES)
    return [pyopencl, pytools, next(iter(_named_by_user()), pocl)]


def _is_full(folder: Path) -> bool:
    with suppress(OSError):
        return shutil.disk_usage(folder).free < LEAST_SPACE
    return False


def _named_by_user() -> list[Path]:
    """The folder that PoCL was told to use, which stands before the folder of caches."""
    return [Path(os.environ["POCL_CACHE_DIR"])] if os.environ.get("POCL_CACHE_DIR") else []


def _fault(folder: Path) -> str:
    """Make a folder and try to write in it; return why that fails, or ''."""
    if not folder.is_absolute():  # of a HOME that is not
        return f"{folder}: is not an absolute path"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"clsplat")
    except OSError as error:
        return f"{folder}: cannot be written ({error.strerror or error})"
    return ""


def _temporary() -> Path:
    """A folder below the temporary one that nobody else can write: the same for all processes of a user, if possible.

    Raises OutputError when there is no temporary folder.
    """
    try:
        base = Path(tempfile.gettempdir())
        folder = base / f"clsplat-{os.getuid()}" if hasattr(os, "getuid") else base / "clsplat-caches"
        if not folder.is_symlink() and not folder.exists():
            folder.mkdir(mode=0o700, exist_ok=True)
        if _private(folder):
            return folder
        folder = Path(tempfile.mkdtemp(prefix="clsplat-"))
    except OSError as error:
        raise OutputError(
            f"no folder for caches can be written ({error.strerror or error}); let XDG_CACHE_HOME or TMPDIR name one"
        ) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _private(folder: Path) -> bool:
    """Whether a folder belongs to this user and nobody else can write or read in it; systems without users: True."""
    if not hasattr(os, "getuid"):  # their temporary folder is the user's own
        return True
    state = folder.lstat()
    return stat.S_ISDIR(state.st_mode) and state.st_uid == os.getuid() and not state.st_mode & 0o077
