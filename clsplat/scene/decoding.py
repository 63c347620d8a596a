"""Decode every photograph and mask of a scene once, before training: a damaged one is found while it costs nothing.

What was decoded is remembered by content and decoder in the user's cache folder: the second time files are only hashed.
"""

import hashlib
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2

from clsplat.caches import cache_folder
from clsplat.errors import DataError, OutputError
from clsplat.progress import Count
from clsplat.reading import read_file
from clsplat.scene.image_headers import TAIL_SIZE, parse_header
from clsplat.scene.images import MAX_BYTES, decode_image
from clsplat.scene.view import NO_FILE, Size, View, is_turned

MAX_THREADS = 8  # each holds one photograph
MAX_REMEMBERED = 1 << 24  # bytes: about 200 000 photographs
MAX_NAMES = 3  # in a message


@dataclass
class ImageFile:
    """What is known of an image file after decoding it."""

    digest: str = ""  # SHA-256 of its content; "" where it cannot be read
    size: Size | None = None  # as stored; None where it cannot be decoded
    orientation: int = 1  # of the EXIF data; 1: upright
    cut: bool = False  # its end is missing
    fault: str = ""  # why it cannot be trained on, as training would say


def decode_all(views: Iterable[View]) -> dict[Path, ImageFile]:
    """Check the photographs and masks of views as load_image does: do they decode, to the size of their camera?

    They are read in threads; a file of several views is decoded once.  Views without a photograph are left out.
    """
    users: dict[Path, list[View]] = defaultdict(list)
    for view in views:
        for file in (view.image_path, view.mask_path, view.static_path):
            if file is not None and file != NO_FILE:
                users[file].append(view)
    found = {file: ImageFile() for file in users}
    memory, count = Memory(), Count("photographs decoded", len(users))
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS), "decoding")
    try:
        futures = [pool.submit(_examine, file, users[file], found[file], memory) for file in users]
        for number, future in enumerate(as_completed(futures), 1):
            future.result()
            count.reach(number)
    finally:
        pool.shutdown(cancel_futures=True)
        memory.save()
    return found


def require_whole(place: Path, files: Mapping[Path, ImageFile]) -> None:
    """Raise DataError, naming the first ones, when image files of the scene at `place` cannot be trained on."""
    damaged = {file: found.fault.removeprefix(f"{file}: ") for file, found in files.items() if found.fault}
    if damaged:
        named = "; ".join(f"{file} ({fault})" for file, fault in list(damaged.items())[:MAX_NAMES])
        more = "; …" if len(damaged) > MAX_NAMES else ""
        raise DataError(f"{place}: {len(damaged)} of {len(files)} image files cannot be trained on: {named}{more}")


def _examine(file: Path, views: list[View], found: ImageFile, memory: "Memory") -> None:
    try:
        data = read_file(file, "an image", limit=MAX_BYTES)
        found.digest = hashlib.sha256(data).hexdigest()
        if header := parse_header(data, data[-TAIL_SIZE:], lambda: data):
            found.orientation, found.cut = header.orientation, not header.complete
        found.size = memory.size(found.digest, data, file)
        for view in views:
            is_turned(view, file, lambda upright: memory.size(found.digest, data, file, upright))
    except DataError as error:
        found.fault = str(error)


class Memory:
    """Sizes of images that this version of the decoder has decoded, by content; of damaged ones nothing is kept.

    They lie in a file of lines in the user's cache folder; where it cannot be used, all images are decoded.
    """

    def __init__(self) -> None:
        self._known: dict[str, Size] = {}
        self._fresh: dict[str, Size] = {}
        self.path: Path | None = None
        with suppress(DataError, OutputError):
            self.path = cache_folder() / "decoded" / f"opencv-{cv2.__version__}.txt"
            lines = read_file(self.path, limit=MAX_REMEMBERED).splitlines(keepends=True)
            self._known = dict(filter(None, map(_entry, lines)))

    def size(self, digest: str, data: bytes, file: Path, upright: bool = False) -> Size:
        """Return (width, height) of the content of `file`, decoding it unless that was done.  Raises DataError."""
        key = f"{digest}-upright" if upright else digest
        if key not in self._known:
            height, width = decode_image(data, file, upright).shape[:2]
            self._known[key] = self._fresh[key] = width, height
        return self._known[key]

    def save(self) -> None:
        """Add what is new, in one write: lines of two processes do not mix, and half a line does not count."""
        if self.path is None or not self._fresh:
            return
        lines = "".join(f"{key} {width} {height}\n" for key, (width, height) in self._fresh.items())
        with suppress(OSError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            full = self.path.exists() and self.path.stat().st_size >= MAX_REMEMBERED
            with self.path.open("wb" if full else "ab", buffering=0) as file:
                file.write(lines.encode())


def _entry(line: bytes) -> tuple[str, Size] | None:
    """The key and the size on a whole line, else None."""
    words = line.split()
    if len(words) != 3 or not line.endswith(b"\n") or not re.fullmatch(rb"\d{1,7} \d{1,7}", b" ".join(words[1:])):
        return None
    return words[0].decode(errors="replace"), (int(words[1]), int(words[2]))
