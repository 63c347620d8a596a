"""PNG files as OpenCV gets them: checked, and without what has nothing to do with pixels.

libpng prints a line on stderr, without the name of the file, for every colour profile, text and date that it does not
like.  PNG (W3C, third edition), sections 5.3 and 5.5.
"""

import struct
import zlib

from clsplat.errors import quoted

SIGNATURE = b"\x89PNG\r\n\x1a\n"
USED = {b"tRNS", b"eXIf", b"acTL", b"fcTL", b"fdAT"}  # beside the critical ones, whose names begin with a capital


def pixels_only(data: bytes) -> bytes:
    """Return a PNG without metadata; what is no PNG is returned as it is.

    Raises ValueError, with the place, where the file is cut or the checksum of a chunk that matters is wrong.
    """
    if not data.startswith(SIGNATURE):
        return data
    view, at, kept = memoryview(data), len(SIGNATURE), [memoryview(SIGNATURE)]
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if end > len(data):
            break
        if kind in USED or not kind[0] & 0x20:
            if zlib.crc32(view[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
                raise ValueError(f"byte {at}: the checksum of the chunk {quoted(kind.decode('latin-1'))} is wrong")
            kept.append(view[at:end])
        if kind == b"IEND":
            return b"".join(kept)
        at = end
    raise ValueError(f"byte {at}: expected another chunk, of which {len(data) - at} bytes are left")
