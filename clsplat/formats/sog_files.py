"""The files of a SOG: in a ZIP, or beside a meta.json."""

import io
import os
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from clsplat.errors import DataError, quoted
from clsplat.formats.splats import MAX_FILE
from clsplat.reading import read_file, read_json

META = "meta.json"
PARTS = ("means", "scales", "quats", "sh0")  # of a meta.json, and shN
MAX_META = 1 << 24  # bytes
MAX_IMAGE = 1 << 30
KINDS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
RATIO = 2  # most bytes of images that one byte of a ZIP may stand for: they are compressed already
SLACK = 1 << 16  # bytes, or px, beyond what the numbers need


def with_images(path: Path) -> list[Path]:
    """Return a meta.json and the images beside it that it names and that are there; of a damaged one it alone."""
    try:
        meta = read_json(path, limit=MAX_META)
    except DataError:
        return [path]
    parts = [meta.get(name) for name in (*PARTS, "shN")] if isinstance(meta, dict) else []
    lists = [part.get("files") for part in parts if isinstance(part, dict)]
    names = {name: None for one in lists if isinstance(one, list) for name in one if isinstance(name, str)}
    images = [path.with_name(name) for name in names if is_beside(name) and name != META]
    return [path, *filter(os.path.isfile, images)]


def is_beside(name: str) -> bool:
    """Whether a name does not leave its folder."""
    return name == Path(name).name and "\\" not in name and bool(name.strip("."))


class Files:
    """The files of a SOG, each read once: members of a ZIP, wherever they lie in it, or files beside a meta.json."""

    def __init__(self, path: Path, archive: zipfile.ZipFile | None = None, size: int = MAX_FILE) -> None:
        self.path, self.archive, self.most = path, archive, size
        self.held: dict[str, bytes] = {}

    @property
    def size(self) -> int:
        """Bytes of those that were read, as they lie on the disk."""
        return min(self.most, sum(map(len, self.held.values())))

    def read(self, name: str) -> bytes:
        """The bytes of a file.  Raises DataError."""
        if name not in self.held:
            self.held[name] = self._member(self.archive, name) if self.archive else self._beside(name)
        return self.held[name]

    def _beside(self, name: str) -> bytes:
        return read_file(self.path.with_name(name), "a file of a SOG", limit=MAX_META if name == META else MAX_IMAGE)

    def _member(self, archive: zipfile.ZipFile, name: str) -> bytes:
        found = next((one for one in archive.infolist() if one.filename.rpartition("/")[2] == name), None)
        if found is None or found.compress_type not in KINDS:
            fault = f"has no {quoted(name)}" if found is None else f"{quoted(name)} is compressed in another way"
            raise DataError(
                f"{self.path}: {fault}; expected the files that {META} names, stored or deflated: export it again"
            )
        images = sum(len(data) for one, data in self.held.items() if one != META)
        most = MAX_META if name == META else min(MAX_IMAGE, SLACK + RATIO * self.most - images)
        with archive.open(found) as member:
            data = member.read(most + 1)
        if len(data) > most:
            raise DataError(f"{self.path}: {quoted(name)} has more than {most} bytes; export it again")
        return data


@contextmanager
def sog_files(path: Path) -> Iterator[Files]:
    """The files of a folder or of a ZIP."""
    if path.name == META:
        yield Files(path)
        return
    data = read_file(path, "a .sog file", limit=MAX_FILE)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            yield Files(path, archive, len(data))
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError, KeyError) as error:
        raise DataError(f"{path}: a damaged ZIP ({quoted(error)}); copy or export the file again") from error
