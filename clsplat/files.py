"""Write files atomically: a reader sees a complete file or none."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from clsplat.errors import OutputError


@contextmanager
def atomic(path: Path) -> Iterator[BinaryIO]:
    """Open a temporary file beside `path`; when the block ends without an error, sync it and rename it to `path`.

    Raises OutputError with the file's name when it cannot be written; an earlier file then stays unchanged.
    """
    if not path.name:
        raise OutputError(f"{path}: cannot be written (it has no name); expected the path of a file")
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); check the folder and its space"
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def unwritable(path: Path, error: OSError) -> OutputError:
    """Return the OutputError for a file that cannot be written."""
    return OutputError(f"{path}: cannot be written ({error.strerror or error}); check the folder and its space")


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically.  Raises OutputError."""
    with atomic(path) as file:
        file.write(text.encode())
