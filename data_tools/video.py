"""Extract sharp frames from a video, with equal camera motion between them."""

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
from clsplat.core.progress import ItemCounter
from clsplat.core.reading import read_json, sha256
from clsplat.scene.images import is_image, read_image_size, write_image
from clsplat.scene.quality import SIDE, sharpness
from clsplat.scene.times_file import write_times

LOG = logging.getLogger("clsplat")
RECORD = ".frames.json"  # the video and settings from which the frames next to it were extracted
FLOW_SIDE = 120  # px: motion is measured at this size
CELLS = 4, 3  # motion is averaged over each cell to suppress noise
STILL = 0.1  # px per frame: smaller motion is noise or compression artifacts


def write_frames(video: Path, out: Path, frames: int = 100, long_side: int | None = None, times: bool = False) -> int:
    """Split a video into `frames` parts of equal motion, write the sharpest frame of each, and return their number.

    long_side: the maximum width and height of the images, px
    times: whether to also write times.json with the index of each frame in the video, for a dynamic scene

    The format is PNG because a second lossy compression would change features and colors.  An interrupted call can be
    repeated: it keeps the frames that were extracted from the same video with the same settings.

    Raises DataError if the video cannot be decoded or has only one frame, or if `out` contains other images.
    """
    settings: dict[str, Any] = {"video": sha256(video, "a video"), "frames": frames, "long_side": long_side}
    remove_partial_files(out, marker=PIPELINE)
    frame_indices = _read_frame_indices(out, settings)
    if frame_indices is None:
        LOG.info("%s: looking for sharp frames", video)
        sharpnesses, motions = _measure_frames(video)
        if len(sharpnesses) == 1:
            raise DataError(f"{video}: has only one frame; use a photo directly, without `clsplat data video`")
        frame_indices = sharpest(sharpnesses, motions, frames)
        LOG.info("%d frames in the video; writing %d of them", len(sharpnesses), len(frame_indices))
        write_text(out / RECORD, json.dumps({**settings, "chosen": frame_indices}) + "\n")
    files = {index: _file(out, i) for i, index in enumerate(frame_indices, 1)}
    counter = ItemCounter("frames written", len(files))
    missing_indices = {index for index, path in files.items() if not _is_readable(path)}
    for index, image in enumerate(decode_frames(video) if missing_indices else ()):
        if index in missing_indices:
            write_image(files[index], np.ascontiguousarray(limit_size(image, long_side)[:, :, ::-1]))
            missing_indices.remove(index)
            counter.reach(counter.done + 1)
    if missing_indices:
        raise DataError(f"{out / RECORD}: lists frame {min(missing_indices)}, which is not in the video; remove {out}")
    if times:
        write_times(out, {path.name: index for index, path in files.items()})
    return len(files)


def _read_frame_indices(out: Path, settings: dict[str, Any]) -> list[int] | None:
    """Return the frame indices that an earlier call with the same settings chose, or None if there was no such call.

    Raises DataError if the folder contains frames of another video or of other settings, or other images.
    """
    record: dict[str, Any] = {}
    with suppress(DataError, ValueError, TypeError):
        record = dict(read_json(out / RECORD))
    frame_indices: list[int] | None = record.pop("chosen", None)
    if not _are_frame_indices(frame_indices):  # damaged: choose the frames again
        frame_indices = None
    if record and record != settings:
        differences = [name for name, value in settings.items() if record.get(name) != value]
        raise DataError(
            f"{out}: contains frames that were extracted with another {' and another '.join(differences)}; use another "
            "folder, or remove it"
        )
    count = len(frame_indices) if frame_indices else settings["frames"] if record else 0
    expected_files = {_file(out, i) for i in range(1, count + 1)}
    other_images = sorted(
        path for path in out.rglob("*") if is_image(path) and path.name[0] != "." and path not in expected_files
    )
    if other_images:
        raise DataError(
            f"{out}: contains {len(other_images)} other images, such as {other_images[0].name}; use another folder"
        )
    return frame_indices


def _file(out: Path, number: int) -> Path:
    return out / f"frame_{number:05d}.png"


def _are_frame_indices(indices: Any) -> bool:
    """Return whether a value is a non-empty list of increasing frame indices."""
    if not isinstance(indices, list) or not all(type(index) is int and index >= 0 for index in indices):
        return False
    return bool(indices) and sorted(set(indices)) == indices


def _is_readable(path: Path) -> bool:
    """Return whether the file exists and is a readable image."""
    try:
        return bool(read_image_size(path))
    except DataError:
        return False


def sharpest(sharpness: Sequence[float], motion: Sequence[float], parts: int) -> list[int]:
    """Return the index of the sharpest frame in each of at most `parts` parts of equal motion.

    motion: motion of each frame relative to the previous one, px

    Of equally sharp frames, the first is chosen.  While the camera is still, at most one frame is chosen.
    If the camera never moves, all parts have the same number of frames.
    """
    path = np.cumsum(np.maximum(np.asarray(motion, float) - STILL, 0))
    if not path[-1] > 0:
        path = np.arange(1.0, len(sharpness) + 1)
    edges = np.searchsorted(path, np.linspace(0, path[-1], min(parts, len(sharpness)) + 1)[1:-1], side="right")
    return [int(a + np.argmax(sharpness[a:b])) for a, b in pairwise([0, *edges.tolist(), len(sharpness)]) if b > a]


def _measure_frames(video: Path) -> tuple[list[float], list[float]]:
    """Return the sharpness of each frame, and the median motion of each frame relative to the previous one, px."""
    sharpnesses: list[float] = []
    motions: list[float] = []
    empty = np.empty(0, np.float32)
    flow, previous = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST), None
    for image in decode_frames(video):
        gray = np.asarray(cv2.cvtColor(limit_size(image, SIDE), cv2.COLOR_BGR2GRAY), np.uint8)
        sharpnesses.append(sharpness(gray))
        small = limit_size(gray, FLOW_SIDE)
        motion = np.zeros((*small.shape, 2), np.float32) if previous is None else flow.calc(previous, small, empty)
        motion = cv2.resize(motion, CELLS, interpolation=cv2.INTER_AREA)
        motions.append(float(np.median(np.linalg.norm(motion, axis=2))))
        previous = small
    return sharpnesses, motions


def decode_frames(video: Path) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames of a video, [H, W, 3] BGR.  Raises DataError if no frame can be decoded."""
    reader = cv2.VideoCapture(str(video))
    try:
        has_frames = False
        while True:
            success, image = reader.read()
            if not success:
                break
            has_frames = True
            yield np.asarray(image, np.uint8)
    finally:
        reader.release()
    if not has_frames:
        raise DataError(f"{video}: not a video that OpenCV decodes; convert it to MP4 (H.264)")


def limit_size(image: NDArray[np.uint8], long_side: int | None) -> NDArray[np.uint8]:
    """Shrink an image so that no side is longer than `long_side` px.  Smaller images are returned unchanged."""
    height, width = image.shape[:2]
    factor = max(height, width) / (long_side or max(height, width))
    if factor <= 1:
        return image
    size = max(1, round(width / factor)), max(1, round(height / factor))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
