"""Image and video files: masks, EXIF orientation, corners, and decoding."""

import shutil
import struct
from pathlib import Path

import cv2
import numpy as np


def blocks(seed: int, width: int, height: int) -> np.ndarray:
    """An image full of corners."""
    rng = np.random.default_rng(seed)
    pixels = np.full((height, width, 3), 128, np.uint8)
    for _ in range(width * height // 300):
        x, y, color = int(rng.integers(width)), int(rng.integers(height)), rng.integers(0, 256, 3).tolist()
        cv2.rectangle(pixels, (x, y), (x + int(rng.integers(3, 25)), y + int(rng.integers(3, 25))), color, -1)
    return cv2.GaussianBlur(pixels, (0, 0), 0.8)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def with_exif(jpeg: bytes, order: str, orientation: int) -> bytes:
    mark = b"II" if order == "<" else b"MM"
    tiff = mark + struct.pack(order + "HIH", 42, 8, 2)
    tiff += struct.pack(order + "HHIHH", 0x10F, 3, 1, 1, 0) + struct.pack(order + "HHIHH", 0x112, 3, 1, orientation, 0)
    thumbnail = b"\xff\xd8\xff\xd9"  # its end is not the photograph's
    body = b"Exif\0\0" + tiff + thumbnail
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpeg[2:]


def store(path: Path, pixels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)
    return path


def masked_scene(source: Path, out: Path, filling: int) -> Path:
    """The scene with a square of every photograph masked by its alpha, and filled with a color."""
    shutil.copytree(source, out)
    for photo in out.rglob("*.png"):
        pixels = cv2.imread(str(photo), cv2.IMREAD_UNCHANGED)[:, :, :3].copy()
        alpha = np.full(pixels.shape[:2], 255, np.uint8)
        alpha[5:20, 8:30], pixels[5:20, 8:30] = 0, filling
        store(photo, np.dstack([pixels, alpha]))
    return out


def with_orientation(path: Path, pixels: np.ndarray, orientation: int) -> Path:
    """A JPEG with an EXIF orientation."""
    _, data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 100])
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    segment = b"\xff\xe1" + struct.pack(">H", len(tiff) + 8) + b"Exif\0\0" + tiff
    path.write_bytes(data.tobytes()[:2] + segment + data.tobytes()[2:])
    return path


def decoded(path):
    reader, results = cv2.VideoCapture(str(path)), []
    while True:
        good, image = reader.read()
        if not good:
            return results, reader.get(cv2.CAP_PROP_FPS)
        results.append(image[:, :, ::-1])
