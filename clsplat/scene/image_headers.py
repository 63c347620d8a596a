"""Read the size and the orientation of a photograph from its first bytes, without decoding it.

PNG (W3C, third edition), JPEG (ITU-T T.81, annex B) and Exif 2.3; other formats are decoded.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

from clsplat.errors import DataError
from clsplat.scene.images import image_size

HEAD_SIZE, TAIL_SIZE = 1 << 18, 1 << 16  # bytes read at either end
PNG, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
JPEG, JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of a frame header
ORIENTATION = 0x0112  # Exif tag


@dataclass(frozen=True)
class Header:
    """Size in pixels as stored, the Exif orientation (1: upright), and whether the file is complete."""

    width: int
    height: int
    orientation: int = 1
    complete: bool = True


def read_header(path: Path) -> Header:
    """Return the header of an image file.  Raises DataError when it cannot be read or is no image."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_SIZE)
            file.seek(max(0, file.seek(0, 2) - TAIL_SIZE))
            tail = file.read()
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: cannot read it ({error}); check the path and its permissions") from error
    found = None
    if head.startswith(PNG) and head[12:16] == b"IHDR" and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        found = Header(width, height, complete=PNG_END in tail or PNG_END in path.read_bytes())
    elif head.startswith(JPEG):
        found = _jpeg(path, head, tail)
    if found is None or not found.width or not found.height:
        return Header(*image_size(path))
    return found


def _jpeg(path: Path, head: bytes, tail: bytes) -> Header | None:
    """Walk the segments up to the frame header; None when the walk fails."""
    at, orientation = 2, 1
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker = head[at + 1]
        if marker == 0xFF:  # fill
            at += 1
            continue
        (length,) = struct.unpack_from(">H", head, at + 2)
        if marker in FRAMES:
            height, width = struct.unpack_from(">HH", head, at + 5)
            # An end marker cannot be part of the pixels; that of a thumbnail lies before them.
            complete = JPEG_END in tail or JPEG_END in path.read_bytes()[at:]
            return Header(width, height, orientation, complete)
        if marker == 0xE1 and head[at + 4 : at + 10] == b"Exif\0\0":
            orientation = _orientation(head[at + 10 : at + 2 + length])
        at += 2 + length
    return None


def _orientation(exif: bytes) -> int:
    """The orientation in a TIFF block, 1 to 8; 1 where there is none."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2])
    if order is None or len(exif) < 8:
        return 1
    (start,) = struct.unpack_from(order + "I", exif, 4)
    entries = struct.unpack_from(order + "H", exif, start)[0] if start + 2 <= len(exif) else 0
    for at in range(start + 2, min(start + 2 + 12 * entries, len(exif) - 11), 12):
        tag, _, _, value = struct.unpack_from(order + "HHIH", exif, at)
        if tag == ORIENTATION:
            return int(value) if 1 <= value <= 8 else 1
    return 1
