"""Identify a scene, independently of its folder, by hashes of its photographs, masks, cameras and points."""

import hashlib
import json
import os
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from clsplat.core.errors import DataError, OutputError, first_few, pluralize
from clsplat.core.machine import cache_folder
from clsplat.core.progress import ItemCounter
from clsplat.core.reading import read_file
from clsplat.scene.images import MAX_BYTES, TAIL_SIZE, decode_image, parse_header
from clsplat.scene.quality import excludes_all, is_blank
from clsplat.scene.scene import SPLITS, Scene
from clsplat.scene.view import NO_FILE, Floats, Size, View, needs_rotation

# Decode every photograph and mask of a scene before training, so that damaged files are found early.

MAX_THREADS = 8  # each thread keeps one photograph in memory
MAX_CACHE_BYTES = 1 << 24  # bytes, about 200,000 photographs
MAX_NAMES = 3  # names in a message
Entry = tuple[int, int, int]  # width, height, and flags as bits: blank, excludes every pixel as a mask, transparent


@dataclass
class ImageFile:
    """The digest and the properties of an image file."""

    digest: str = ""  # SHA-256 of the content; "" if the file cannot be read
    size: Size | None = None  # size as stored; None if the file cannot be decoded
    orientation: int = 1  # from EXIF; 1: upright
    is_truncated: bool = False  # whether the end of the file is missing
    fault: str = ""  # the error that training would report
    is_blank: bool = False  # whether the image is black, of a single color, or transparent
    excludes_all: bool = False  # whether the image, as a mask, excludes every pixel
    is_transparent: bool = False  # whether the alpha channel excludes every pixel


def decode_all(views: Iterable[View]) -> dict[Path, ImageFile]:
    """Decode the photographs and masks of views in threads, and check that their sizes fit the cameras.

    Returns the result for each file; a file that several views share is read once.  Views without files are skipped.
    """
    views_by_path: dict[Path, list[View]] = defaultdict(list)
    for view in views:
        for file in (view.image_path, view.mask_path, view.static_path):
            if file is not None and file != NO_FILE:
                views_by_path[file].append(view)
    files = {file: ImageFile() for file in views_by_path}
    cache, counter = DecodedSizes(), ItemCounter("photos decoded", len(views_by_path))
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS), "decoding")
    try:
        futures = [pool.submit(_examine, file, views_by_path[file], files[file], cache) for file in views_by_path]
        for number, future in enumerate(as_completed(futures), 1):
            future.result()
            counter.reach(number)
    finally:
        pool.shutdown(cancel_futures=True)
        cache.save()
    return files


def require_decodable(path: Path, files: Mapping[Path, ImageFile]) -> None:
    """Raise DataError if some image files of the scene at `path` cannot be used for training."""
    faults = {file: result.fault.removeprefix(f"{file}: ") for file, result in files.items() if result.fault}
    if faults:
        examples = "; ".join(f"{file} ({fault})" for file, fault in list(faults.items())[:MAX_NAMES])
        more = "; …" if len(faults) > MAX_NAMES else ""
        raise DataError(f"{path}: {len(faults)} of {len(files)} image files cannot be used: {examples}{more}")


def require_content(path: Path, views: Sequence[View], files: Mapping[Path, ImageFile]) -> list[str]:
    """Return the names of the views with blank photographs.

    Raises DataError, as training would, if all photographs are blank or if a mask excludes an entire photograph.
    """
    masked_views = [view for view in views if _is_excluded(view, files)]
    if masked_views:
        examples = first_few([f"{view.name} ({view.mask_path or view.image_path})" for view in masked_views])
        raise DataError(
            f"{path}: masks exclude every pixel of {pluralize(len(masked_views), 'photo')}: {examples}; masks must be "
            "white (255) in usable pixels: correct them, or remove these photos"
        )
    blank_names = [view.name for view in views if view.image_path in files and files[view.image_path].is_blank]
    if blank_names and len(blank_names) == len(views):
        raise DataError(
            f"{path}: all photos are blank: {first_few(blank_names)} are black, a single color, or transparent; "
            "export them again"
        )
    return blank_names


def _is_excluded(view: View, files: Mapping[Path, ImageFile]) -> bool:
    mask, image = (files.get(file) if file else None for file in (view.mask_path, view.image_path))
    return bool((mask and mask.excludes_all) or (view.alpha == "mask" and image and image.is_transparent))


def _examine(file: Path, views: list[View], result: ImageFile, cache: "DecodedSizes") -> None:
    try:
        data = read_file(file, "an image", limit=MAX_BYTES)
        result.digest = hashlib.sha256(data).hexdigest()
        if header := parse_header(data, data[-TAIL_SIZE:], lambda: data):
            result.orientation, result.is_truncated = header.orientation, not header.is_complete
        result.size = cache.get_size(result.digest, data, file)
        result.is_blank, result.excludes_all, result.is_transparent = cache.flags(result.digest)
        for view in views:
            needs_rotation(view, file, lambda upright: cache.get_size(result.digest, data, file, upright))
    except DataError as error:
        result.fault = str(error)


class DecodedSizes:
    """A cache of the sizes and flags of images that this version of OpenCV has decoded, by the hash of their content.

    It is a text file in the user's cache folder; without a usable cache folder, all images are decoded.
    """

    def __init__(self) -> None:
        self._entries: dict[str, Entry] = {}
        self._new: dict[str, Entry] = {}
        self.path: Path | None = None
        with suppress(DataError, OutputError):
            self.path = cache_folder() / "decoded" / f"opencv-{cv2.__version__}-contents.txt"
            lines = read_file(self.path, limit=MAX_CACHE_BYTES).splitlines(keepends=True)
            self._entries = dict(filter(None, map(_parse_entry, lines)))

    def get_size(self, digest: str, data: bytes, file: Path, upright: bool = False) -> Size:
        """Return (width, height) of an image file, px; decode `data` if the size is not cached.  Raises DataError."""
        key = f"{digest}-upright" if upright else digest
        if key not in self._entries:
            pixels = decode_image(data, file, upright)
            is_transparent = pixels.shape[2] == 4 and excludes_all(pixels[:, :, 3])
            flags = is_blank(pixels), excludes_all(pixels[:, :, 0]), is_transparent
            height, width = pixels.shape[:2]
            self._entries[key] = self._new[key] = width, height, sum(2**i for i, is_set in enumerate(flags) if is_set)
        return self._entries[key][:2]

    def flags(self, digest: str) -> tuple[bool, bool, bool]:
        """Return whether a cached image is blank, excludes all pixels as a mask, and is transparent everywhere."""
        bits = self._entries[digest][2]
        return bool(bits & 1), bool(bits & 2), bool(bits & 4)

    def save(self) -> None:
        """Append the new entries in one write, so that lines of several processes do not mix."""
        if self.path is None or not self._new:
            return
        lines = "".join(f"{key} {width} {height} {bits}\n" for key, (width, height, bits) in self._new.items())
        with suppress(OSError):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            is_full = self.path.exists() and self.path.stat().st_size >= MAX_CACHE_BYTES
            with self.path.open("wb" if is_full else "ab", buffering=0) as file:
                file.write(lines.encode())


def _parse_entry(line: bytes) -> tuple[str, Entry] | None:
    """Return the key and the entry on a line of the cache file; None if the line is incomplete or damaged."""
    fields = line.split()
    is_complete = len(fields) == 4 and line.endswith(b"\n")
    if not is_complete or not re.fullmatch(rb"\d{1,7} \d{1,7} [0-7]", b" ".join(fields[1:])):
        return None
    return fields[0].decode(errors="replace"), (int(fields[1]), int(fields[2]), int(fields[3]))


Row = dict[str, str]  # hashes of a view's photograph, mask, and camera ("" if missing), and its time, if any


@dataclass(frozen=True)
class Identity:
    """Hashes of the points and of the views.  The views are grouped by split, in the order of the scene.

    Cameras and points are hashed after parsing, so rewriting a file with the same values changes nothing.
    """

    train: dict[str, Row]
    test: dict[str, Row]
    points: str
    validation: dict[str, Row] = field(default_factory=dict)

    @classmethod
    def from_scene(cls, scene: Scene, files: Mapping[Path, ImageFile]) -> "Identity":
        """Return the identity of a scene; files: the results of `decode_all`."""
        train, test, fold = (
            {view.name: _view_hashes(view, files, scene.origin) for view in scene.split(name)} for name in SPLITS
        )
        points = scene.points
        arrays = [points.positions, points.colors, points.times] if points else []
        return cls(train, test, _hash(*(array for array in arrays if array is not None)) if points else "", fold)

    @property
    def digest(self) -> str:
        """The hash of everything in the scene that affects the bits of a run.  Test views may be in any order."""
        values = [list(self.train.items()), sorted(self.test.items()), self.points]
        values += [list(self.validation.items())] if self.validation else []
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

    def changes(self, previous: "Identity") -> list[str]:
        """List the changes since `previous`, with counts and the first few names: 'the photo of 2 views (…)'."""
        changes = []
        old, new = previous._rows, self._rows
        for key in ("photograph", "mask", "camera", "time"):
            names = [name for name in old if name in new and old[name].get(key) != new[name].get(key)]
            noun = "photo" if key == "photograph" else key
            changes += [f"the {noun} of {_list_views(names)}"] if names else []
        moved_names = [name for name in old if name in new and previous._splits(name) != self._splits(name)]
        removed, added = [name for name in old if name not in new], [name for name in new if name not in old]
        changes += [f"the split of {_list_views(moved_names)}"] if moved_names else []
        changes += [f"{_list_views(removed)}, removed"] if removed else []
        changes += [f"{_list_views(added)}, added"] if added else []
        if not (moved_names or removed or added) and list(self.train) != list(previous.train):
            changes.append("the order of the training views")
        return changes + (["the points"] if self.points != previous.points else [])

    @property
    def _rows(self) -> dict[str, Row]:
        return self.train | self.test | self.validation

    def _splits(self, name: str) -> tuple[bool, bool]:
        return name in self.train, name in self.validation

    def data(self) -> dict[str, Any]:
        """Return the identity as plain data for JSON."""
        return {"digest": self.digest, **asdict(self)}

    @classmethod
    def from_data(cls, data: Any) -> "Identity":
        """Restore an identity from the result of `data`.  Raises ValueError if it is damaged."""
        try:
            train, test, points = dict(data["train"]), dict(data["test"]), str(data["points"])
            identity = cls(train, test, points, dict(data["validation"]))
            if identity.digest == data["digest"]:
                return identity
        except (KeyError, TypeError, ValueError):
            pass
        raise ValueError("damaged")


def _view_hashes(view: View, files: Mapping[Path, ImageFile], origin: Floats) -> Row:
    camera, lens = view.camera, view.lens
    values = [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, view.downscale]
    distortion = [lens.model, lens.width, lens.height, lens.keep_border, *map(float, lens.params)] if lens else []
    return {
        "photograph": _photograph_digest(view, files),
        "mask": files[view.mask_path].digest if view.mask_path else "",
        "camera": _hash(values, view.world_to_camera, *([origin] if origin.any() else []), text=repr(distortion)),
        **({} if view.time is None else {"time": repr(view.time)}),
    }


def _photograph_digest(view: View, files: Mapping[Path, ImageFile]) -> str:
    if view.image is not None:
        return _hash(view.image, text=str(view.image.dtype))
    return files[view.image_path].digest if view.image_path in files else ""


def _hash(*arrays: ArrayLike, text: str = "") -> str:
    """Return the SHA-256 hash of a text and of arrays, converted to little-endian float64; -0 counts as 0."""
    state = hashlib.sha256(text.encode())
    for array in arrays:
        values = np.asarray(array, np.float64) + 0.0
        state.update(repr(values.shape).encode() + values.astype("<f8").tobytes())
    return state.hexdigest()


def _list_views(names: list[str]) -> str:
    more = ", …" if len(names) > MAX_NAMES else ""
    return f"{len(names)} view{'s' if len(names) > 1 else ''} ({', '.join(names[:MAX_NAMES])}{more})"
