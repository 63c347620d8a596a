"""Record which files a tool wrote and from which sources, to resume interrupted calls and to protect users' files."""

import hashlib
import json
from pathlib import Path

from clsplat.core.errors import DataError
from clsplat.core.files import PIPELINE, append, make_folder, remove_partial_files, write_error
from clsplat.core.reading import read_file, sha256

RECORD = ".manifest.jsonl"


class Manifest:
    """The record of a folder: one line per file that a tool wrote, with a hash of the file's sources.

    A file is written atomically after its line is on disk, and an outdated file is removed before its new line is
    written.  So every file that exists is complete and was made from the sources in its last line.  Temporary files of
    killed processes are removed.
    """

    def __init__(self, folder: Path) -> None:
        remove_partial_files(folder, marker=PIPELINE)
        self.folder, self._sources = folder, dict[str, str]()
        for line in _read_lines(folder / RECORD):
            try:
                entry = json.loads(line)
                self._sources[str(entry["file"])] = str(entry["from"])
            except (ValueError, TypeError, KeyError):
                continue  # incomplete, after a crash

    def has_entry(self, path: Path) -> bool:
        """Return whether a tool wrote this file, or was about to write it."""
        return self._name(path) in self._sources

    def needs_writing(self, path: Path, source: str, *companions: Path) -> bool:
        """Return whether a file must be written because it is missing or was made from other sources.

        If so, remove the file and its `companions`, and record the new source.  The caller must write the companions
        before the file.  A file that no tool wrote is never replaced.  Raises OutputError.
        """
        name, is_file = self._name(path), path.is_file()
        if is_file and self._sources.get(name, source) == source:
            return False
        try:
            for file in (path, *companions):
                file.unlink(missing_ok=True)
            if self._sources.get(name) != source:
                make_folder(self.folder)
                line = "\n" + json.dumps({"file": name, "from": source})  # the last line may be incomplete
                append(self.folder / RECORD, line.encode())
        except OSError as error:
            raise write_error(path, error) from error
        self._sources[name] = source
        return True

    def require_listed(self, path: Path) -> None:
        """Raise DataError if a file exists that no tool wrote."""
        if path.is_file() and not self.has_entry(path):
            raise DataError(f"{path}: exists, and was not created from this scene; use another folder, or remove it")

    def _name(self, path: Path) -> str:
        return path.relative_to(self.folder).as_posix()


def hash_values(*values: object) -> str:
    """Return a hash of values; a path is hashed by the content of its file.  Raises DataError."""
    state = hashlib.sha256()
    for value in values:
        content = sha256(value) if isinstance(value, Path) else repr(value)
        state.update(f"{content}\n".encode())
    return state.hexdigest()


def _read_lines(path: Path) -> list[str]:
    try:
        return read_file(path).decode(errors="replace").splitlines()
    except DataError:
        return []
