"""The planes of an SPZ file: numbers as bytes, and bytes as numbers (layout: spz.py)."""

import logging
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.formats.packing import beyond_bytes, from_smallest_three, smallest_three, tell_cut
from clsplat.formats.splats import MAX_DEGREE, PARAMETERS, Parameters, Writing, logits, opacities, sh_coefficients, unit

LOG = logging.getLogger("clsplat")
MAGIC = b"NGSP"
MIP, EXTENSIONS = 1, 2  # flags
HEADER = 16  # bytes
STORED_DEGREE = 4  # which the format knows; bands beyond MAX_DEGREE are dropped
COLOUR = 0.15
MAX_INT24 = 2**23 - 1
FRACTION, FINE_FRACTION = 12, 20  # bits of positions; the second for quality high
ROWS = 1 << 13  # that are decoded at once: what that takes beside the result is little
QUALITY = {"small": (6, 5), "balanced": (8, 8), "high": (8, 8)}  # bits of band 1 and of the others


@dataclass(frozen=True)
class Header:
    """The numbers that begin a file."""

    version: int
    count: int
    degree: int
    fraction: int  # bits
    flags: int

    @classmethod
    def of(cls, path: Path, data: bytes) -> "Header":
        """Take them from the first bytes.  Raises DataError where they cannot be."""
        if len(data) < HEADER or data[:4] != MAGIC:
            raise DataError(f"{path}: not an SPZ file; expected its header of {HEADER} bytes: copy or export it again")
        version, count, degree, fraction, flags = struct.unpack_from("<2I3B", data, 4)
        if not 1 <= version <= 4 or degree > STORED_DEGREE or fraction > 23:
            raise DataError(
                f"{path}: SPZ of version {version}, SH degree {degree}, {fraction} fractional bits; expected version "
                "1 to 4, degree 0 to 4, at most 23 bits: export it again"
            )
        return cls(version, count, degree, fraction, flags)

    @property
    def sizes(self) -> list[int]:
        """Bytes of each plane."""
        widths = (6 if self.version == 1 else 9, 1, 3, 3, 3 if self.version < 3 else 4)
        return [self.count * width for width in (*widths, 3 * (sh_coefficients(self.degree) - 1))]


def unpacked(header: Header, planes: Sequence[Callable[[int], bytes]]) -> Parameters:
    """Return the parameters that the bytes of the planes stand for: of each, what returns the next so many bytes."""
    byte = np.arange(256, dtype=np.float32)
    levels = {
        "logit_opacity": logits(np.arange(256) / 255.0),
        "sh_base": ((np.arange(256) / 255.0 - 0.5) / COLOUR).astype(np.float32),
        "log_scales": byte / np.float32(16) - np.float32(10),
        "sh_rest": (byte - np.float32(128)) / np.float32(128),
    }
    columns = 3 * (sh_coefficients(min(header.degree, MAX_DEGREE)) - 1)
    widths = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacity": 1, "sh_base": 3, "sh_rest": columns}
    found = {name: np.empty((header.count, widths[name]), np.float32) for name in PARAMETERS}
    order = ("means", "logit_opacity", "sh_base", "log_scales", "quats", "sh_rest")
    for name, size, plane in zip(order, header.sizes, planes, strict=False):  # of degree 0 there may be no last one
        for start in range(0, header.count if size else 0, ROWS):
            part = found[name][start : start + ROWS]
            data = np.frombuffer(plane(size // header.count * len(part)), np.uint8).reshape(len(part), -1)
            if name == "means":
                part[:] = _positions(header, data)
            elif name == "quats":
                part[:] = _three_bytes(data) if header.version < 3 else _four_bytes(data)
            else:
                part[:] = levels[name][data[:, : widths[name]]]
    return found


def _positions(header: Header, data: NDArray[np.uint8]) -> NDArray[np.float32]:
    if header.version == 1:
        return data.view("<f2").astype(np.float32)
    low, middle, high = data.reshape(-1, 3).astype(np.int32).T
    whole = (low | middle << 8 | (high ^ 128) << 16) - (1 << 23)
    return (whole.astype(np.float32) / np.float32(2**header.fraction)).reshape(-1, 3)


def _three_bytes(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    xyz = packed / 127.5 - 1
    w = np.sqrt(np.maximum(1 - np.square(xyz).sum(axis=1, keepdims=True), 0))
    return np.concatenate([w, xyz], axis=1).astype(np.float32)


def _four_bytes(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    bits = packed.view("<u4")[:, 0]
    parts = [bits >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)]
    others = np.stack([(part & 511) / 511 * 0.5**0.5 * np.where(part & 512, -1, 1) for part in parts], axis=1)
    xyzw = from_smallest_three((bits >> np.uint32(30)).astype(np.intp), others)
    return np.roll(xyzw, 1, axis=1)


def fraction_of(path: Path, means: NDArray[np.float32], fine: bool) -> int:
    """Return bits after the point with which every position fits into 24; where they are few, say so.

    Raises DataError for positions that do not fit without any.
    """
    largest = float(np.abs(means).max(initial=0))
    bits = min(FINE_FRACTION if fine else FRACTION, math.floor(math.log2(MAX_INT24 / max(largest, 1e-9))))
    if bits < 0:
        raise DataError(f"{path}: SPZ holds positions to {MAX_INT24}; the model has {largest:g}: crop it")
    if bits < FRACTION:
        LOG.warning(
            "%s: its largest coordinate is %g: SPZ keeps all positions in steps of %.3g, not %.3g, scene units; a crop "
            "keeps them finer",
            path,
            largest,
            2.0**-bits,
            2.0**-FRACTION,
        )
    return bits


def packed(path: Path, p: Parameters, fraction: int, options: Writing) -> list[bytes]:
    """Return the bytes of each plane; values beyond its range are cut."""
    fixed = np.rint(p["means"].astype(np.float64) * 2**fraction).astype("<i4")
    largest, others = smallest_three(np.roll(unit(p["quats"]), -1, axis=1))
    levels = np.minimum(np.rint(511 * np.abs(others) * 2**0.5), 511).astype(np.uint32)
    levels |= (others < 0).astype(np.uint32) << np.uint32(9)
    rotations = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        rotations |= levels[:, i] << np.uint32(shift)
    cut = {
        "alphas": 255 * opacities(p["logit_opacity"]),
        "colours": 255 * (COLOUR * p["sh_base"].astype(np.float64) + 0.5),
        "scales": 16 * (p["log_scales"].astype(np.float64) + 10),
        "harmonics": _rounded_bits(p["sh_rest"], options.sh_bits or QUALITY[options.quality]),
    }
    tell_cut(path, "SPZ", "harmonics from -1 to 1", np.abs(p["sh_rest"]) > 1)
    tell_cut(path, "SPZ", "colours from -0.44 to 1.44", beyond_bytes(cut["colours"]))
    tell_cut(path, "SPZ", "scales from 4.5e-05 to 379", beyond_bytes(cut["scales"]))
    alphas, colours, scales, harmonics = (np.clip(np.rint(v), 0, 255).astype(np.uint8).tobytes() for v in cut.values())
    positions = np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 4)[:, :3]).tobytes()
    return [positions, alphas, colours, scales, rotations.astype("<u4").tobytes(), harmonics]


def _rounded_bits(rest: NDArray[np.float32], bits: tuple[int, int]) -> NDArray[np.float64]:
    """Harmonics as levels around 128, rounded to multiples of 2^(8 - bits)."""
    steps = np.full(rest.shape[1], 2.0 ** (8 - bits[1]))
    steps[:9] = 2.0 ** (8 - bits[0])
    levels: NDArray[np.float64] = np.rint(128 * rest.astype(np.float64) / steps) * steps + 128
    return levels
