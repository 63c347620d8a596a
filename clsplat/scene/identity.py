"""What a scene is, whatever its folder is called: content hashes of its photographs, masks, cameras and points."""

import hashlib
import json
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from clsplat.core.errors import DataError, OutputError
from clsplat.core.machine import cache_folder
from clsplat.core.progress import Count
from clsplat.core.reading import read_file
from clsplat.scene.images import MAX_BYTES, TAIL_SIZE, decode_image, parse_header
from clsplat.scene.scene import SPLITS, PointCloud, Scene
from clsplat.scene.view import NO_FILE, Floats, Size, View, needs_rotation

# Decode every photograph and mask of a scene once, before training: a damaged one is found while it costs nothing.

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


def require_decodable(place: Path, files: Mapping[Path, ImageFile]) -> None:
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
            needs_rotation(view, file, lambda upright: memory.size(found.digest, data, file, upright))
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


Row = dict[str, str]  # photograph, mask and camera of a view: hashes, "" where there is none; the time where it has one


@dataclass(frozen=True)
class Identity:
    """The views by split and name, in the order of the scene, and the points.

    Cameras and points count as they were read, so a file that was written again with the same numbers is the same.
    """

    train: dict[str, Row]
    test: dict[str, Row]
    points: str
    validation: dict[str, Row] = field(default_factory=dict)

    @classmethod
    def from_scene(cls, scene: Scene, files: Mapping[Path, ImageFile]) -> "Identity":
        """Return the identity of a scene whose image files were decoded."""
        train, test, fold = (
            {view.name: _row(view, files, scene.origin) for view in scene.split(name)} for name in SPLITS
        )
        return cls(train, test, _points_hash(scene.points) if scene.points else "", fold)

    @property
    def digest(self) -> str:
        """One hash of all that decides over the bits of a run: the order of the test views does not."""
        parts = [list(self.train.items()), sorted(self.test.items()), self.points]
        parts += [list(self.validation.items())] if self.validation else []
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def changes(self, before: "Identity") -> list[str]:
        """Return what is another than it was, with counts and the first few names: 'the photographs of 2 views (…)'."""
        found = []
        old, new = before._rows, self._rows
        for part in ("photograph", "mask", "camera", "time"):
            names = [name for name in old if name in new and old[name].get(part) != new[name].get(part)]
            found += [f"the {part} of {_named(names)}"] if names else []
        moved = [name for name in old if name in new and before._split_of(name) != self._split_of(name)]
        gone, fresh = [name for name in old if name not in new], [name for name in new if name not in old]
        found += [f"the split of {_named(moved)}"] if moved else []
        found += [f"{_named(gone)}, gone"] if gone else []
        found += [f"{_named(fresh)}, new"] if fresh else []
        if not (moved or gone or fresh) and list(self.train) != list(before.train):
            found.append("the order of the training views")
        return found + (["the points"] if self.points != before.points else [])

    @property
    def _rows(self) -> dict[str, Row]:
        return self.train | self.test | self.validation

    def _split_of(self, name: str) -> tuple[bool, bool]:
        return name in self.train, name in self.validation

    def data(self) -> dict[str, Any]:
        """Return the identity as plain data for JSON."""
        return {"digest": self.digest, **asdict(self)}

    @classmethod
    def from_data(cls, data: Any) -> "Identity":
        """Return what `data` returned.  Raises ValueError where it is damaged."""
        try:
            train, test, points = dict(data["train"]), dict(data["test"]), str(data["points"])
            found = cls(train, test, points, dict(data["validation"]))
            if found.digest == data["digest"]:
                return found
        except (KeyError, TypeError, ValueError):
            pass
        raise ValueError("damaged")


def _row(view: View, files: Mapping[Path, ImageFile], origin: Floats) -> Row:
    camera, lens = view.camera, view.lens
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, view.downscale]
    distortion = [lens.model, lens.width, lens.height, lens.whole, *map(float, lens.params)] if lens else []
    return {
        "photograph": files[view.image_path].digest if view.image_path in files else "",
        "mask": files[view.mask_path].digest if view.mask_path else "",
        "camera": _hash(numbers, view.world_to_camera, *([origin] if origin.any() else []), text=repr(distortion)),
        **({} if view.time is None else {"time": repr(view.time)}),
    }


def _points_hash(points: PointCloud) -> str:
    return _hash(points.positions, points.colors, *([] if points.times is None else [points.times]))


def _hash(*arrays: ArrayLike, text: str = "") -> str:
    """A hash of the values of arrays, in double precision and little-endian; -0 is 0."""
    state = hashlib.sha256(text.encode())
    for array in arrays:
        values = np.asarray(array, np.float64) + 0.0
        state.update(repr(values.shape).encode() + values.astype("<f8").tobytes())
    return state.hexdigest()


def _named(names: list[str]) -> str:
    more = ", …" if len(names) > MAX_NAMES else ""
    return f"{len(names)} view{'s' if len(names) > 1 else ''} ({', '.join(names[:MAX_NAMES])}{more})"
