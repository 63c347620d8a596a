"""Files as they are written, with their SHA-256."""

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from clsplat.files import atomic


class Output:
    """A file that is written once, from start to end."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._sum = file, hashlib.sha256()

    def write(self, data: bytes) -> None:
        self._file.write(data)
        self._sum.update(data)

    @property
    def sha256(self) -> str:
        """Of what was written so far, as `sha256sum` prints it."""
        return self._sum.hexdigest()


@contextmanager
def written(path: Path) -> Iterator[Output]:
    """Open a file as `atomic` does.  Raises OutputError."""
    with atomic(path) as file:
        yield Output(file)
