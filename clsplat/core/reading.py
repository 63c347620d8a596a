"""Read regular files of limited size; pipes and devices are rejected, because reading them may never end."""

import errno
import hashlib
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

from clsplat.core.errors import ClsplatError, DataError

MAX_JSON = 1 << 28  # bytes
FILE_TYPES = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}

CONTENT_STARTS = (  # the first bytes of unexpected content, its description, and a remedy
    (b"version https://git-lfs", "a Git LFS pointer", "fetch the content with `git lfs pull`"),
    (b"<!doctype", "a web page", "download the file itself"),
    (b"<html", "a web page", "download the file itself"),
    (b"\x1f\x8b", "compressed with gzip", "unpack it"),
)


def require_content(path: Path, data: bytes, error_type: type[ClsplatError] = DataError) -> None:
    """Raise `error_type` if a file that starts with `data` is empty or is the result of a failed download."""
    if not data:
        raise error_type(f"{path}: the file is empty; copy or export it again")
    for start, content, remedy in CONTENT_STARTS:
        if data.lstrip()[: len(start)].lower() == start:
            raise error_type(f"{path}: the file is {content}; {remedy}")


@contextmanager
def open_file(
    path: Path, description: str = "a file", error_type: type[ClsplatError] = DataError, limit: int | None = None
) -> Iterator[BufferedReader]:
    """Open a regular file of at most `limit` bytes for reading.

    Raises `error_type` when opening fails or when the block fails to read.
    """
    try:
        with open_regular(path, limit) as file:
            yield file
    except OSError as error:
        raise error_type(f"{path}: cannot be read ({error.strerror or error}); expected {description}") from error


def read_file(
    path: Path, description: str = "a file", error_type: type[ClsplatError] = DataError, limit: int | None = None
) -> bytes:
    """Return the bytes of a regular file.  Raises `error_type`, as `open_file` does."""
    with open_file(path, description, error_type, limit) as file:
        return file.read()


def read_text(
    path: Path, description: str = "a text file", error_type: type[ClsplatError] = DataError, limit: int | None = None
) -> str:
    """Return the UTF-8 text of a regular file.  Raises `error_type`, with the line number of an invalid byte."""
    try:
        return read_file(path, description, error_type, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line, byte = error.object[: error.start].count(b"\n") + 1, error.object[error.start]
        raise error_type(f"{path}:{line}: expected UTF-8 text, found {byte:#x}; save the file as UTF-8") from error


def sha256(path: Path, description: str = "a file", error_type: type[ClsplatError] = DataError) -> str:
    """Return the SHA-256 of a regular file, as `sha256sum` prints it.  Raises `error_type`."""
    with open_file(path, description, error_type) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(
    path: Path, description: str = "a JSON file", error_type: type[ClsplatError] = DataError, limit: int = MAX_JSON
) -> Any:
    """Return the content of a JSON file.  Raises `error_type` if it cannot be read or parsed."""
    data = read_file(path, description, error_type, limit)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        require_content(path, data, error_type)
        reason = str(error).partition(";")[0]
        raise error_type(f"{path}: not a JSON file ({reason}); expected {description}: create it again") from error


def open_regular(path: Path, limit: int | None = None) -> BufferedReader:
    """Open a regular file of at most `limit` bytes, as `open_file` does, but raise OSError."""
    try:
        state = os.stat(path)
    except ValueError as error:  # a NUL in the name, or text that cannot be encoded
        raise OSError(errno.EINVAL, "not a valid file name") from error
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, f"it is {FILE_TYPES.get(stat.S_IFMT(state.st_mode), 'not a regular file')}")
    if limit is not None and state.st_size > limit:
        raise OSError(errno.EFBIG, f"it has {state.st_size} bytes, more than the limit of {limit}")
    return path.open("rb")
