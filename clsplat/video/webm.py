"""The numbers that FFmpeg draws by chance for the tracks of a WebM file.

A file is a tree of elements: an id and a size, of 1 to 8 bytes each, and what they hold (RFC 8794, RFC 9559).
"""

from collections.abc import Iterator
from pathlib import Path

SEGMENT, TRACKS, TRACK, TAGS, TAG, TARGETS = 0x18538067, 0x1654AE6B, 0xAE, 0x1254C367, 0x7373, 0x63C0
PARENTS = {SEGMENT, TRACKS, TRACK, TAGS, TAG, TARGETS}
CLUSTER = 0x1F43B675  # the first pictures: the tracks stand before them
UIDS = {0x73C5, 0x63C5}  # of a track, and of a track that a tag belongs to
HEAD = 1 << 16  # bytes that hold all of them


def without_chance(path: Path) -> None:
    """Give every track of a WebM file the number 1, in place, so that the same pictures give the same file."""
    with path.open("rb+") as file:
        head = file.read(HEAD)
        for start, size in _uids(head, 0, len(head)):
            file.seek(start)
            file.write((1).to_bytes(size, "big"))


def _uids(data: bytes, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Place and size of each number."""
    while start + 2 <= end:
        kind, start = _number(data, start, marked=True)
        size, start = _number(data, start, marked=False)
        if kind == CLUSTER or start > end:
            return
        if kind in UIDS and start + size <= end:
            yield start, size
        elif kind in PARENTS:
            yield from _uids(data, start, min(start + size, end))
        start += size


def _number(data: bytes, start: int, marked: bool) -> tuple[int, int]:
    """A number whose leading zero bits tell how many bytes it has, with that mark or without it, and where it ends."""
    length = 9 - data[start].bit_length() if start < len(data) else 1
    value = int.from_bytes(data[start : start + length], "big")
    return (value if marked else value & ((1 << (7 * length)) - 1)), start + length
