"""What a camera noted of a photograph's exposure: Exif 2.3 in JPEG files, or a file beside images that lost it."""

import json
import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from clsplat.errors import DataError
from clsplat.files import write_text
from clsplat.reading import opened, read_json
from clsplat.scene.image_headers import HEAD_SIZE, exif_segment, orientation_place

BESIDE = "exposures.json"  # in a folder of images
SUB_FOLDER = 0x8769  # tags: where those of the exposure are
SECONDS, APERTURE, ISO = 0x829A, 0x829D, 0x8827
MAKE, MODEL, FOCAL, FOCAL_35 = 0x010F, 0x0110, 0x920A, 0xA405  # mm, and mm on film of 35 mm
TEXT, SHORT, LONG, RATIONAL = 2, 3, 4, 5  # kinds of values
POSSIBLE = ((1e-7, 1e5), (0.1, 1e3), (0.1, 1e8))  # seconds, f-number, ISO
Value = float | str


@dataclass(frozen=True)
class CameraExposure:
    """The settings that decide how bright a photograph of the same light is."""

    seconds: float
    aperture: float  # f-number
    iso: float

    @property
    def value(self) -> float:
        """The logarithm to base 2 of the light that makes a photograph, by its sensitivity."""
        return math.log2(self.seconds * self.iso / self.aperture**2)


def exposure_of(path: Path) -> CameraExposure | None:
    """Return the exposure that a JPEG file tells; None where it does not.  Raises DataError when it cannot be read."""
    with opened(path, "an image") as file:
        return parsed(file.read(HEAD_SIZE))


def parsed(head: bytes) -> CameraExposure | None:
    """Return the exposure in the first bytes of a JPEG file, or None."""
    tags = _tags(head)
    return checked(tags.get(SECONDS), tags.get(APERTURE), tags.get(ISO))


def optics_of(path: Path) -> tuple[Value, ...] | None:
    """Return make, model and focal lengths of the camera that took a JPEG file; None where it does not tell them.

    Raises DataError when it cannot be read.
    """
    with opened(path, "an image") as file:
        tags = _tags(file.read(HEAD_SIZE))
    told = [tags.get(tag, "") for tag in (MAKE, MODEL, FOCAL, FOCAL_35)]
    return tuple(told) if any(told[2:]) else None


def copied(head: bytes, jpeg: bytes) -> bytes:
    """Return a JPEG file of upright pixels with the EXIF data in the first bytes of another, but for the rotation."""
    found = exif_segment(head)
    if found is None:
        return jpeg
    at, length = found
    block = bytearray(head[at : at + 2 + length])
    if place := orientation_place(bytes(block[10:])):
        block[10 + place : 12 + place] = struct.pack({b"II": "<H", b"MM": ">H"}[bytes(block[10:12])], 1)
    return jpeg[:2] + bytes(block) + jpeg[2:]


def _tags(head: bytes) -> dict[int, Value]:
    """What the first bytes of a JPEG file tell by tag, as far as it can be read."""
    found = exif_segment(head)
    tags: dict[int, Value] = {}
    if found is None:
        return tags
    at, length = found
    block = head[at + 10 : at + 2 + length]
    with suppress(struct.error, KeyError, ValueError):  # cut, without such a folder, or with no number for its place
        order = {b"II": "<", b"MM": ">"}[block[:2]]
        (start,) = struct.unpack_from(order + "I", block, 4)
        tags.update(_values(block, order, int(start)))
        tags.update(_values(block, order, int(tags[SUB_FOLDER])))
    return tags


def _values(block: bytes, order: str, start: int) -> dict[int, Value]:
    """The numbers and texts of a folder of tags; of several numbers the first."""
    found: dict[int, Value] = {}
    (entries,) = struct.unpack_from(order + "H", block, start)
    for at in range(start + 2, start + 2 + 12 * entries, 12):
        tag, kind, count, value = struct.unpack_from(order + "HHII", block, at)
        if kind == RATIONAL:
            above, below = struct.unpack_from(order + "II", block, value)
            if below:
                found[tag] = above / below
        elif kind in (SHORT, LONG):
            (found[tag],) = struct.unpack_from(order + ("H" if kind == SHORT else "I"), block, at + 8)
        elif kind == TEXT:
            place = value if count > 4 else at + 8
            found[tag] = block[place : place + count].split(b"\0")[0].decode("ascii", "replace").strip()
    return found


def checked(seconds: object, aperture: object, iso: object) -> CameraExposure | None:
    """Return an exposure, or None where a value is no number that a camera can have."""
    numbers = [float(one) for one in (seconds, aperture, iso) if isinstance(one, int | float)]
    possible = len(numbers) == 3 and all(low < one < high for one, (low, high) in zip(numbers, POSSIBLE, strict=True))
    return CameraExposure(*numbers) if possible else None


def write_exposures(folder: Path, exposures: Mapping[str, CameraExposure | None]) -> None:
    """Write the exposures of the images of a folder, by name, where any is known.  Raises OutputError."""
    known = {name: asdict(exposure) for name, exposure in exposures.items() if exposure}
    if known:
        write_text(folder / BESIDE, json.dumps(known, indent=1) + "\n")


def read_exposures(folder: Path) -> dict[str, CameraExposure]:
    """Return the exposures that lie beside the images of a folder; none where there is no such file.

    Raises DataError where it is damaged.
    """
    path = folder / BESIDE
    if not path.is_file():
        return {}
    data, expected = (
        read_json(path, "exposures of images"),
        "expected {name: {seconds, aperture, iso}}: remove it",
    )
    if not isinstance(data, dict):
        raise DataError(f"{path}: {expected}")
    found = {}
    for name, row in data.items():
        if not isinstance(row, dict) or not (exposure := checked(*map(row.get, ("seconds", "aperture", "iso")))):
            raise DataError(f"{path}: the exposure of one image is not three positive numbers; {expected}")
        found[name] = exposure
    return found
