"""The size, the orientation and the end of a photograph, from its bytes, without decoding it.

PNG (W3C, third edition), JPEG (ITU-T T.81, annex B) and Exif 2.3.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass

HEAD_SIZE, TAIL_SIZE = 1 << 18, 1 << 16  # bytes that are looked at, at either end
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


def parse_header(head: bytes, tail: bytes, whole: Callable[[], bytes]) -> Header | None:
    """Return the header of a PNG or JPEG file from its first and last bytes; None for anything else.

    `whole` returns all bytes: it is called where neither end holds what is looked for.
    """
    found = None
    if head.startswith(PNG) and head[12:16] == b"IHDR" and len(head) >= 24:
        width, height = struct.unpack_from(">II", head, 16)
        found = Header(width, height, complete=PNG_END in tail or PNG_END in whole())
    elif head.startswith(JPEG):
        found = _jpeg(head, tail, whole)
    return found if found and found.width and found.height else None


def is_cut(data: bytes) -> bool:
    """Return whether the end of a PNG or JPEG file is missing; False for other formats."""
    header = parse_header(data, data[-TAIL_SIZE:], lambda: data)
    return header is not None and not header.complete


def _jpeg(head: bytes, tail: bytes, whole: Callable[[], bytes]) -> Header | None:
    """Walk the segments up to the frame header; None when the walk fails."""
    orientation = 1
    for marker, at, length in segments(head):
        if marker in FRAMES:
            height, width = struct.unpack_from(">HH", head, at + 5)
            # An end marker cannot be part of the pixels; that of a thumbnail lies before them.
            complete = JPEG_END in tail or whole().find(JPEG_END, at) >= 0
            return Header(width, height, orientation, complete)
        if _is_exif(head, marker, at):
            orientation = _orientation(head[at + 10 : at + 2 + length])
    return None


def exif_segment(head: bytes) -> tuple[int, int] | None:
    """Return the place and the length of the Exif segment in the first bytes of a JPEG file; None without one.

    Its block of tags begins 10 bytes behind the place.
    """
    found = ((at, length) for marker, at, length in segments(head) if _is_exif(head, marker, at))
    return next(found, None) if head.startswith(JPEG) else None


def _is_exif(head: bytes, marker: int, at: int) -> bool:
    return marker == 0xE1 and head[at + 4 : at + 10] == b"Exif\0\0"


def segments(head: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the marker, the place and the length of the segments of a JPEG file; none behind a damaged one."""
    at = 2
    while at + 9 <= len(head) and head[at] == 0xFF:
        marker = head[at + 1]
        if marker == 0xFF:  # fill
            at += 1
            continue
        (length,) = struct.unpack_from(">H", head, at + 2)
        yield marker, at, length
        at += 2 + length


def _orientation(exif: bytes) -> int:
    """The orientation in a TIFF block, 1 to 8; 1 where there is none."""
    at = orientation_place(exif)
    value = struct.unpack_from({b"II": "<", b"MM": ">"}[exif[:2]] + "H", exif, at)[0] if at else 1
    return int(value) if 1 <= value <= 8 else 1


def orientation_place(exif: bytes) -> int | None:
    """Return where the orientation, 2 bytes, lies in a TIFF block; None where there is none."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2])
    if order is None or len(exif) < 8:
        return None
    (start,) = struct.unpack_from(order + "I", exif, 4)
    entries = struct.unpack_from(order + "H", exif, start)[0] if start + 2 <= len(exif) else 0
    for at in range(start + 2, min(start + 2 + 12 * entries, len(exif) - 11), 12):
        if struct.unpack_from(order + "H", exif, at)[0] == ORIENTATION:
            return at + 8
    return None
