"""Frames of the videos of several cameras, at the same moments of each."""

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


def write_sync_frames(scene: Path, moments: int, long_side: int | None = None) -> int:
    """Write frames of `scene/videos/NAME.mp4` into `scene/videos/NAME/`, evenly spaced; return the number of cameras.

    The moments are the same of all cameras: the videos start together and have one rate.  Of a video with more frames
    than another the end is left out, with a warning.  Folders with that number of frames stay as they are.
    Raises DataError where there is no video, one cannot be decoded, or a folder holds another number of frames.
    """
    folder = scene / VIDEOS
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    videos = [file for file in files if file.suffix.lower() in VIDEO_SUFFIXES and file.name[0] != "."]
    if not videos:
        raise DataError(f"{folder}: holds no videos; expected {VIDEOS}/NAME.mp4 of each camera")
    lengths = {video: _length(video) for video in videos}
    least = min(lengths.values())
    if longer := [video.name for video, length in lengths.items() if length > least]:
        LOG.warning("%s: the end of %s is left out: another video has only %d frames", folder, first_few(longer), least)
    if not 2 <= moments <= least:
        raise DataError(f"{folder}: {moments} moments of videos with {least} frames; expected 2 to {least}")
    places = np.linspace(0, least - 1, moments).round().astype(int).tolist()
    count = Count("frames written", moments * len(videos))
    for video in videos:
        out = video.with_suffix("")
        there = [file for file in out.iterdir() if is_image(file)] if out.is_dir() else []
        if there and len(there) != moments:
            raise DataError(f"{out}: holds {len(there)} frames; expected none, or {moments}: remove that folder")
        if not there:
            _write(video, out, places, long_side)
        count.reach(count.done + moments)
    return len(videos)


def _length(video: Path) -> int:
    """The number of frames, which headers do not always tell."""
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


def _write(video: Path, out: Path, places: list[int], long_side: int | None) -> None:
    """Write the frames at these places, all or none."""
    with new_folder(out) as half:
        for place, image in enumerate(decoded(video)):
            for number in (i for i, wanted in enumerate(places) if wanted == place):
                write_image(half / f"{number:04}.png", np.ascontiguousarray(limited(image, long_side)[:, :, ::-1]))
