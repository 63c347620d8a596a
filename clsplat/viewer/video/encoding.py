"""Write videos: WebM (VP8) with OpenCV, MP4 (H.264) with PyAV.  The same images give the same bytes."""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from importlib import import_module
from itertools import chain
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, OutputError
from clsplat.core.files import atomic_path, check_result_path
from clsplat.metrics.images import to_8_bits
from clsplat.viewer.video.paths import Size, check_fps, check_size

# Random track IDs that FFmpeg writes into WebM files.

SEGMENT, TRACKS, TRACK, TAGS, TAG, TARGETS = 0x18538067, 0x1654AE6B, 0xAE, 0x1254C367, 0x7373, 0x63C0
PARENTS = {SEGMENT, TRACKS, TRACK, TAGS, TAG, TARGETS}
CLUSTER = 0x1F43B675  # EBML ID of the first cluster of frames, which follows the tracks
UIDS = {0x73C5, 0x63C5}  # TrackUID, and TagTrackUID
HEAD = 1 << 16  # bytes at the start of a file that contain all UIDs


def fix_track_ids(path: Path) -> None:
    """Set the UID of every track of a WebM file to 1, in place, so that equal images give equal files."""
    with path.open("rb+") as file:
        head = file.read(HEAD)
        for start, size in _find_uids(head, 0, len(head)):
            file.seek(start)
            file.write((1).to_bytes(size, "big"))


def _find_uids(data: bytes, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield the offset and size of each UID in EBML data."""
    while start + 2 <= end:
        kind, start = _read_integer(data, start, keep_marker=True)
        size, start = _read_integer(data, start, keep_marker=False)
        if kind == CLUSTER or start > end:
            return
        if kind in UIDS and start + size <= end:
            yield start, size
        elif kind in PARENTS:
            yield from _find_uids(data, start, min(start + size, end))
        start += size


def _read_integer(data: bytes, start: int, keep_marker: bool) -> tuple[int, int]:
    """Read an EBML variable-length integer, with or without its length marker; return it and the offset of its end."""
    length = 9 - data[start].bit_length() if start < len(data) else 1
    value = int.from_bytes(data[start : start + length], "big")
    return (value if keep_marker else value & ((1 << (7 * length)) - 1)), start + length


Image = NDArray[np.uint8]
Write = Callable[[Image], None]  # writes a frame, RGB, [height, width, 3]
CODEC = "VP80"  # with OpenCV's settings, VP9 reaches the same size and PSNR in 4.5 times the time
QUALITY = "18"  # constant rate factor of H.264: visually almost lossless
NO_MB_TREE = "0"  # with AVX-512, x264's macroblock tree is not deterministic
BT709 = 1  # FFmpeg's code of the color space
ALTERNATIVE = "or write images with --out DIR, which any encoder reads"


def check_file(path: Path) -> None:
    """Raise ConfigError if the suffix is unknown or has no encoder, or if the name is reserved for a file of a run."""
    check_encoder(path)
    check_result_path(path, path.suffix.lower())


def check_encoder(path: Path) -> None:
    """Raise ConfigError if there is no encoder for the suffix of a video."""
    suffix = path.suffix.lower()
    if suffix not in WRITERS:
        raise ConfigError(f"{path}: expected the name of a video that ends in {' or '.join(WRITERS)}")
    if suffix == ".mp4":
        _require_av()


@contextmanager
def open_video(path: Path, size: Size, fps: float) -> Iterator[Write]:
    """Yield a function that writes a frame.  At the end of the block, the file is read back as a check.

    size: width and height of a frame, px, both even.  If the video cannot be written or read back, raises OutputError
    and does not change an existing file.
    """
    suffix, count = path.suffix.lower(), 0
    with atomic_path(path, suffix) as temporary:
        with WRITERS[suffix](temporary, size, fps) as write:

            def write_and_count(image: Image) -> None:
                nonlocal count
                count += 1
                write(image)

            yield write_and_count
        if suffix == ".webm":
            fix_track_ids(temporary)
        if (readable_count := count_frames(temporary)) != count:
            raise OutputError(
                f"{path}: {readable_count} of {count} frames can be read back; check the folder and the free space"
            )
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())


def write_video(path: Path, images: Iterable[NDArray[np.generic]], fps: float) -> int:
    """Write images of equal size, [height, width, 3] uint8 or floats in [0, 1]; return their number.

    Raises ConfigError for an invalid name, rate, or size, and ValueError if there are no images or their sizes differ.
    """
    check_file(path)
    check_fps(fps)
    frames = map(to_8_bits, images)
    first = next(frames, None)
    if first is None:
        raise ValueError("a video needs at least one image")
    height, width = first.shape[:2]
    count = 0
    with open_video(path, check_size((width, height)), fps) as write:
        for frame in chain([first], frames):
            if frame.shape != (height, width, 3):
                raise ValueError(f"image {count} has shape {frame.shape}; expected {(height, width, 3)}")
            write(frame)
            count += 1
    return count


def count_frames(path: Path) -> int:
    """Return the number of decodable frames of a video."""
    reader, count = cv2.VideoCapture(str(path)), 0
    try:
        while reader.grab():
            count += 1
    finally:
        reader.release()
    return count


@contextmanager
def _open_webm(path: Path, size: Size, fps: float) -> Iterator[Write]:
    with _without_codec_message():
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*CODEC), float(fps), size)
    try:
        if not writer.isOpened():
            raise OutputError(
                f"{path.parent}: OpenCV cannot write WebM (VP8); check the folder, install OpenCV from pip, "
                f"which includes FFmpeg, or write .mp4 with the extra `video`, {ALTERNATIVE}"
            )

        def write(image: Image) -> None:
            writer.write(np.ascontiguousarray(image[:, :, ::-1]))

        yield write
    finally:
        writer.release()


@contextmanager
def _open_mp4(path: Path, size: Size, fps: float) -> Iterator[Write]:
    av = _require_av()
    try:
        with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            stream.width, stream.height = size
            stream.pix_fmt, stream.options = "yuv420p", {"crf": QUALITY, "mbtree": NO_MB_TREE}
            context = stream.codec_context
            context.thread_count = 1  # the bits depend on the number of threads
            context.colorspace = context.color_primaries = context.color_trc = BT709

            def write(image: Image) -> None:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
                frame = frame.reformat(format="yuv420p", dst_colorspace=BT709)
                for packet in stream.encode(frame):
                    container.mux(packet)

            yield write
            for packet in stream.encode(None):
                container.mux(packet)
    except av.FFmpegError as error:
        raise OSError(error.errno, error.strerror) from error


WRITERS: dict[str, Callable[[Path, Size, float], AbstractContextManager[Write]]] = {
    ".webm": _open_webm,
    ".mp4": _open_mp4,
}


def _require_av() -> ModuleType:
    try:
        return import_module("av")
    except ImportError as error:
        raise ConfigError(
            f"MP4 needs PyAV; in a checkout, run `pip install '.[video]'`, or use the suffix .webm, {ALTERNATIVE}"
        ) from error


@contextmanager
def _without_codec_message() -> Iterator[None]:
    """Discard a message about the codec from OpenCV's FFmpeg, which no setting suppresses."""
    try:
        stderr_copy = os.dup(2)
    except OSError:  # closed
        yield
        return
    with open(os.devnull, "wb") as null_device:
        os.dup2(null_device.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(stderr_copy, 2)
        os.close(stderr_copy)
