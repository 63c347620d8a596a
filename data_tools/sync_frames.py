"""Extract synchronized frames from the videos of several cameras."""

import logging
from pathlib import Path

import cv2
import numpy as np

from clsplat.core.errors import DataError, first_few
from clsplat.core.files import new_folder
from clsplat.core.progress import Count
from clsplat.scene.images import is_image, write_image
from clsplat.scene.multicamera import VIDEO_SUFFIXES, VIDEOS

from .video import decoded, limited

LOG = logging.getLogger("clsplat")


def write_sync_frames(scene: Path, frames: int, long_side: int | None = None) -> int:
    """Write frames of `scene/videos/NAME.mp4` into `scene/videos/NAME/`, evenly spaced; return the number of cameras.

    All cameras use the same frame numbers, so the videos must start together and have the same frame rate.  Frames
    past the end of the shortest video are ignored, with a warning.  Folders that already hold `frames` frames are kept.
    Raises DataError if there are no videos, a video cannot be decoded, or a folder holds another number of frames.
    """
    folder = scene / VIDEOS
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES and file.name[0] != "."]
    if not videos:
        raise DataError(f"{folder}: holds no videos; expected {VIDEOS}/NAME.mp4 of each camera")
    lengths = {video: _length(video) for video in videos}
    shortest = min(lengths.values())
    if longer := [video.name for video, length in lengths.items() if length > shortest]:
        LOG.warning("%s: the end of %s is ignored: another video has %d frames", folder, first_few(longer), shortest)
    if not 2 <= frames <= shortest:
        raise DataError(f"{folder}: cannot extract {frames} frames from videos of {shortest}; use 2 to {shortest}")
    frame_indices = np.linspace(0, shortest - 1, frames).round().astype(int).tolist()
    count = Count("frames written", frames * len(videos))
    for video in videos:
        out = video.with_suffix("")
        existing = [file for file in out.iterdir() if is_image(file)] if out.is_dir() else []
        if existing and len(existing) != frames:
            raise DataError(f"{out}: holds {len(existing)} frames, expected {frames}; remove that folder")
        if not existing:
            _write(video, out, frame_indices, long_side)
        count.reach(count.done + frames)
    return len(videos)


def _length(video: Path) -> int:
    """Return the number of frames, counted since headers are not always right."""
    reader = cv2.VideoCapture(str(video))
    try:
        count = 0
        while reader.grab():
            count += 1
    finally:
        reader.release()
    if not count:
        raise DataError(f"{video}: not a video that OpenCV decodes; convert it to MP4 (H.264)")
    return count


def _write(video: Path, out: Path, indices: list[int], long_side: int | None) -> None:
    """Write the frames with these indices as 0000.png, 0001.png, …, all or none."""
    with new_folder(out) as folder:
        for index, image in enumerate(decoded(video)):
            for number in (i for i, wanted in enumerate(indices) if wanted == index):
                write_image(folder / f"{number:04}.png", np.ascontiguousarray(limited(image, long_side)[:, :, ::-1]))
