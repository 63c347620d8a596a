"""Read regular files of limited size; pipes and devices are refused, because they may never end."""

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
KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}

STARTS = (  # the first bytes of unexpected content, its description, and a remedy
    (b"version https://git-lfs", "a Git LFS pointer", "fetch the content with `git lfs pull`"),
    (b"<!doctype", "a web page", "download the file itself"),
    (b"<html", "a web page", "download the file itself"),
    (b"\x1f\x8b", "compressed with gzip", "unpack it"),
)


def require_content(path: Path, data: bytes, kind: type[ClsplatError] = DataError) -> None:
    """Raise an error of type `kind` if a file that starts with `data` is empty or a failed download."""
    if not data:
        raise kind(f"{path}: the file is empty; copy or export it again")
    for start, content, remedy in STARTS:
        if data.lstrip()[: len(start)].lower() == start:
            raise kind(f"{path}: the file is {content}; {remedy}")


@contextmanager
def open_file(
    path: Path, expected: str = "a file", kind: type[ClsplatError] = DataError, limit: int | None = None
) -> Iterator[BufferedReader]:
    """Open a regular file of at most `limit` bytes for reading.

    Raises an error of type `kind` when opening fails or when the block fails to read.
    """
    try:
        with open_regular(path, limit) as file:
            yield file
    except OSError as error:
        raise kind(f"{path}: cannot be read ({error.strerror or error}); expected {expected}") from error


def read_file(
    path: Path, expected: str = "a file", kind: type[ClsplatError] = DataError, limit: int | None = None
) -> bytes:
    """Return the bytes of a regular file.  Raises DataError, or another `kind`, as `open_file` does."""
    with open_file(path, expected, kind, limit) as file:
        return file.read()


def read_text(
    path: Path, expected: str = "a text file", kind: type[ClsplatError] = DataError, limit: int | None = None
) -> str:
    """Return the UTF-8 text of a regular file.  Raises DataError, or another `kind`, with the line of invalid bytes."""
    try:
        return read_file(path, expected, kind, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise kind(f"{path}:{line}: expected UTF-8 text, found the byte {error.object[error.start]:#x}") from error


def sha256(path: Path, expected: str = "a file", kind: type[ClsplatError] = DataError) -> str:
    """Return the SHA-256 of a regular file, as `sha256sum` prints it.  Raises DataError, or another `kind`."""
    with open_file(path, expected, kind) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def read_json(
    path: Path, expected: str = "a JSON file", kind: type[ClsplatError] = DataError, limit: int = MAX_JSON
) -> Any:
    """Return the content of a JSON file.  Raises DataError, or another `kind`, if it cannot be read or parsed."""
    data = read_file(path, expected, kind, limit)
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        require_content(path, data, kind)
        reason = str(error).partition(";")[0]
        raise kind(f"{path}: not a JSON file ({reason}); expected {expected}: create it again") from error


def open_regular(path: Path, limit: int | None = None) -> BufferedReader:
    """Open a regular file of at most `limit` bytes, as `open_file` does, but raise OSError."""
    try:
        state = os.stat(path)
    except ValueError as error:  # a NUL in the name, or text that cannot be encoded
        raise OSError(errno.EINVAL, "not a valid file name") from error
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, f"it is {KINDS.get(stat.S_IFMT(state.st_mode), 'not a regular file')}")
    if limit is not None and state.st_size > limit:
        raise OSError(errno.EFBIG, f"it has {state.st_size} bytes, more than {limit}")
    return path.open("rb")
