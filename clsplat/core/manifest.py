"""Which files of a folder a tool has made, and from what: an interrupted call goes on, and files of users stay."""

import hashlib
import json
from pathlib import Path

from clsplat.core.errors import DataError
from clsplat.core.files import append, make_folder, write_error
from clsplat.core.reading import read_file, sha256

RECORD = ".manifest.jsonl"


class Manifest:
    """The record of a folder: a line for each file, with a hash of what it is made from.

    Files are written whole, after their line is on the disk; a file that was made from something else is removed before
    its new line.
    So a file that exists is complete, and made from what its last line says.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._sources = folder, dict[str, str]()
        for line in _lines(folder / RECORD):
            try:
                entry = json.loads(line)
                self._sources[str(entry["file"])] = str(entry["from"])
            except (ValueError, TypeError, KeyError):
                continue  # cut short

    def lists(self, path: Path) -> bool:
        """Return whether a tool has made this file, or was about to."""
        return self._name(path) in self._sources

    def needs_writing(self, path: Path, source: str, *beside: Path) -> bool:
        """Return whether a file must be written: it is not there, or was made from something else.

        Then it is removed, with the files `beside` it that are written first, and noted.  A file that no tool has made
        is not due.  Raises OutputError.
        """
        name, exists = self._name(path), path.is_file()
        if exists and self._sources.get(name, source) == source:
            return False
        try:
            for file in (path, *beside):
                file.unlink(missing_ok=True)
            if self._sources.get(name) != source:
                make_folder(self.folder)
                line = "\n" + json.dumps({"file": name, "from": source})  # behind a line cut short
                append(self.folder / RECORD, line.encode())
        except OSError as error:
            raise write_error(path, error) from error
        self._sources[name] = source
        return True

    def require_listed(self, path: Path) -> None:
        """Raise DataError when a file exists that no tool has made."""
        if path.is_file() and not self.lists(path):
            raise DataError(f"{path}: exists, and was not made from this scene; give another folder, or remove it")

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()


def hash_values(*parts: object) -> str:
    """Return a hash of values; a path stands for the content of its file.  Raises DataError."""
    state = hashlib.sha256()
    for part in parts:
        content = sha256(part) if isinstance(part, Path) else repr(part)
        state.update(f"{content}\n".encode())
    return state.hexdigest()


def _lines(path: Path) -> list[str]:
    try:
        return read_file(path).decode(errors="replace").splitlines()
    except DataError:
        return []
