"""The folder of what may be lost: kernels that were built, runtimes that were tested."""

import atexit
import logging
import os
import shutil
import stat
import tempfile
from functools import cache
from pathlib import Path

import platformdirs

from clsplat.errors import OutputError

LOG = logging.getLogger("clsplat")
LIBRARIES = ("pyopencl", "pytools", "pocl")  # keep caches beside ours, and fail where they cannot


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
        fault = next(filter(None, map(_fault, [*folders, *named_by_user()])), "")
        if not fault:
            return folders[0]
    moved = _temporary()
    LOG.warning("%s; caches are in %s instead; XDG_CACHE_HOME can name a folder that lasts", fault, moved)
    os.environ["XDG_CACHE_HOME"] = str(moved)  # what all libraries read, in this process and those that it starts
    if named_by_user():
        os.environ["POCL_CACHE_DIR"] = str(moved / "pocl")
    ours = moved / "clsplat"
    if fault := _fault(ours):
        raise OutputError(f"{fault}; free its space, or let TMPDIR name a folder that can be written")
    return ours


def named_by_user() -> list[Path]:
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
