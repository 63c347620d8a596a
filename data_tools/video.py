"""Sharp frames of a video, with the same motion between them."""

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import PIPELINE, remove_partial_files, write_text
from clsplat.core.progress import Count
from clsplat.core.reading import read_json, sha256
from clsplat.scene.images import image_size, is_image, write_image
from clsplat.scene.quality import SIDE, sharpness
from clsplat.scene.times_file import write_times

LOG = logging.getLogger("clsplat")
RECORD = ".frames.json"  # next to the frames: what they were made from
FLOW_SIDE = 120  # px: motion is measured at this size
CELLS = 4, 3  # in each of which the motion of all pixels is averaged, so that noise has little
STILL = 0.1  # px from one frame to the next: what noise and coding leave of it


def write_frames(video: Path, out: Path, frames: int = 100, long_side: int | None = None, times: bool = False) -> int:
    """Write the sharpest frame of each of `frames` parts of a video with the same motion as PNG; return their number.

    The format is PNG because a second lossy coding changes features and colors.  An interrupted call continues: frames
    of the same video and settings stay unchanged.  times: also write times.json, of a dynamic scene: the number of
    each frame in the video.
    Raises DataError when the video cannot be decoded, or has one frame, as a picture has, and when `out` holds other
    images, which would mix with frames.
    """
    settings: dict[str, Any] = {"video": sha256(video, "a video"), "frames": frames, "long_side": long_side}
    remove_partial_files(out, border=PIPELINE)
    chosen = _begun(out, settings)
    if chosen is None:
        LOG.info("%s: looking for sharp frames", video)
        sharp, moved = _measured(video)
        if len(sharp) == 1:
            raise DataError(f"{video}: has only one frame; a photograph can be used without `clsplat data video`")
        chosen = sharpest(sharp, moved, frames)
        LOG.info("%d frames, of which %d are written", len(sharp), len(chosen))
        write_text(out / RECORD, json.dumps({**settings, "chosen": chosen}) + "\n")
    files = {place: _file(out, i) for i, place in enumerate(chosen, 1)}
    count = Count("frames written", len(files))
    missing = {place for place, path in files.items() if not _is_whole(path)}
    for place, image in enumerate(decoded(video) if missing else ()):
        if place in missing:
            write_image(files[place], np.ascontiguousarray(limited(image, long_side)[:, :, ::-1]))
            missing.remove(place)
            count.reach(count.done + 1)
    if missing:
        raise DataError(f"{out / RECORD}: names frame {min(missing)}, which the video does not have; remove {out}")
    if times:
        write_times(out, {path.name: place for place, path in files.items()})
    return len(files)


def _begun(out: Path, settings: dict[str, Any]) -> list[int] | None:
    """The frames that a call with the same settings has chosen, or None.  Raises DataError for a folder of others."""
    record: dict[str, Any] = {}
    with suppress(DataError, ValueError, TypeError):
        record = dict(read_json(out / RECORD))
    chosen: list[int] | None = record.pop("chosen", None)
    if not _are_places(chosen):  # damaged: the frames are chosen again
        chosen = None
    if record and record != settings:
        changed = [name for name, value in settings.items() if record.get(name) != value]
        raise DataError(
            f"{out}: holds frames that were extracted with another {' and another '.join(changed)}; use another "
            "folder, or remove it"
        )
    count = len(chosen) if chosen else settings["frames"] if record else 0
    own = {_file(out, i) for i in range(1, count + 1)}
    others = sorted(path for path in out.rglob("*") if is_image(path) and path.name[0] != "." and path not in own)
    if others:
        raise DataError(
            f"{out}: holds {len(others)} images already, such as {others[0].name}, with which the frames would mix; "
            "use another folder"
        )
    return chosen


def _file(out: Path, number: int) -> Path:
    return out / f"frame_{number:05d}.png"


def _are_places(chosen: Any) -> bool:
    """Return whether these are frames of a video, in its order."""
    if not isinstance(chosen, list) or not all(type(place) is int and place >= 0 for place in chosen):
        return False
    return bool(chosen) and sorted(set(chosen)) == chosen


def _is_whole(path: Path) -> bool:
    """Return whether a frame was written and can be read."""
    try:
        return bool(image_size(path))
    except DataError:
        return False


def sharpest(sharpness: Sequence[float], motion: Sequence[float], parts: int) -> list[int]:
    """Return the index of the sharpest frame in each of at most `parts` parts with the same motion, the first of
    equal ones.

    motion: of each frame from the one before, px.  A camera that rests gives one frame, however long it does; where it
    always rests, parts are equally long.
    """
    way = np.cumsum(np.maximum(np.asarray(motion, float) - STILL, 0))
    if not way[-1] > 0:
        way = np.arange(1.0, len(sharpness) + 1)
    edges = np.searchsorted(way, np.linspace(0, way[-1], min(parts, len(sharpness)) + 1)[1:-1], side="right")
    return [int(a + np.argmax(sharpness[a:b])) for a, b in pairwise([0, *edges.tolist(), len(sharpness)]) if b > a]


def _measured(video: Path) -> tuple[list[float], list[float]]:
    """Sharpness of each frame, and the middle length of its motion from the frame before, px."""
    sharp: list[float] = []
    moved: list[float] = []
    empty = np.empty(0, np.float32)
    flow, before = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST), None
    for image in decoded(video):
        gray = np.asarray(cv2.cvtColor(limited(image, SIDE), cv2.COLOR_BGR2GRAY), np.uint8)
        sharp.append(sharpness(gray))
        small = limited(gray, FLOW_SIDE)
        way = np.zeros((*small.shape, 2), np.float32) if before is None else flow.calc(before, small, empty)
        way = cv2.resize(way, CELLS, interpolation=cv2.INTER_AREA)
        moved.append(float(np.median(np.linalg.norm(way, axis=2))))
        before = small
    return sharp, moved


def decoded(video: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a video, [H, W, 3] BGR.  Raises DataError when there is none."""
    reader = cv2.VideoCapture(str(video))
    try:
        found = False
        while True:
            good, image = reader.read()
            if not good:
                break
            found = True
            yield np.asarray(image, np.uint8)
    finally:
        reader.release()
    if not found:
        raise DataError(f"{video}: not a video that OpenCV decodes; convert it to MP4 (H.264)")


def limited(image: NDArray[np.uint8], long_side: int | None) -> NDArray[np.uint8]:
    """Return the image with no side longer than `long_side` px."""
    height, width = image.shape[:2]
    factor = max(height, width) / (long_side or max(height, width))
    if factor <= 1:
        return image
    size = max(1, round(width / factor)), max(1, round(height / factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
