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
from clsplat.formats.sh_rounding import base_for, rounded_rows, steps, usual_step, visible_form
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
WHOLE = (8, 8)  # bits of harmonics
# steps of harmonics, in levels of 256: of the Gaussian of median weight, for the usual size and at most; of any one
MEDIAN_STEP = {"small": (7.5, 12.5), "balanced": (3.0, 5.0), "high": (1.0, 1.0)}
LARGEST_STEP = {"small": 128.0, "balanced": 64.0, "high": 1.0}
# step of positions: a share of the smallest deviation, for a Gaussian of median weight
SMALLEST_SHARE = {"small": 0.5, "balanced": 0.5, "high": 0.0}
# steps of colours, in levels of 255: of the Gaussian of median weight, and at most
BASE_STEP = {"small": (2**0.5, 16.0), "balanced": (2**0.5, 16.0), "high": (1.0, 1.0)}
MAX_ZEROS = 16  # last bits of a position, at most
TURN_STEP = {"small": 4, "balanced": 4, "high": 1}  # levels of quaternions, of 511


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


def packed(path: Path, p: Parameters, weights: NDArray[np.float64], fraction: int, options: Writing) -> list[bytes]:
    """Return the bytes of each plane; values beyond its range are cut.

    weights: binary logarithms, [N], of weights.py.  Gaussians whose harmonics have fine steps come first, and keep
    their order among themselves: alike bytes compress.
    """
    sh_steps = _sh_steps(p["sh_rest"], weights, options)
    order = np.argsort(sh_steps, kind="stable")
    p, weights = {name: table[order] for name, table in p.items()}, weights[order]
    harmonics, base = _rounded_sh(p, sh_steps[order], options.sh_bits)
    cut = {
        "alphas": 255 * opacities(p["logit_opacity"]),
        "colours": 255 * (COLOUR * base.astype(np.float64) + 0.5),
        "scales": 16 * (p["log_scales"].astype(np.float64) + 10),
    }
    tell_cut(path, "SPZ", "harmonics from -1 to 1", np.abs(p["sh_rest"]) > 1)
    tell_cut(path, "SPZ", "colours from -0.44 to 1.44", beyond_bytes(cut["colours"]))
    tell_cut(path, "SPZ", "scales from 4.5e-05 to 379", beyond_bytes(cut["scales"]))
    step = steps(weights, *BASE_STEP[options.quality])[:, None]
    cut["colours"] = np.rint(cut["colours"] / step) * step
    alphas, colours, scales = (np.clip(np.rint(v), 0, 255).astype(np.uint8).tobytes() for v in cut.values())
    positions = _fixed(p, weights, fraction, SMALLEST_SHARE[options.quality])
    rotations = _rotations(p["quats"], TURN_STEP[options.quality])
    return [positions, alphas, colours, scales, rotations, harmonics.tobytes()]


def _fixed(p: Parameters, weights: NDArray[np.float64], fraction: int, share: float) -> bytes:
    """Positions in 24 bits, in steps of about `share` of the smallest standard deviation, and more where weights are
    small: powers of two."""
    size = p["log_scales"].min(axis=1, keepdims=True).astype(np.float64) / np.log(2) - weights[:, None] / 2
    step = np.exp2(np.clip(np.floor(size + np.log2(share) + fraction), 0, MAX_ZEROS)) if share else 1.0
    multiples = np.rint(p["means"].astype(np.float64) * 2**fraction / step) * step
    fixed = np.minimum(multiples, MAX_INT24 + 1 - step).astype("<i4")
    return np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 4)[:, :3]).tobytes()


def _rotations(quats: NDArray[np.float32], step: int) -> bytes:
    """The three smallest components of quaternions in 9 bits, as multiples of `step`, their signs, and which."""
    largest, others = smallest_three(np.roll(unit(quats), -1, axis=1))
    multiples = np.rint(511 / step * np.abs(others) * 2**0.5) * step
    levels = np.minimum(multiples, 511).astype(np.uint32)
    levels |= (others < 0).astype(np.uint32) << np.uint32(9)
    rotations = largest.astype(np.uint32) << np.uint32(30)
    for i, shift in enumerate((20, 10, 0)):
        rotations |= levels[:, i] << np.uint32(shift)
    return rotations.astype("<u4").tobytes()


def _sh_steps(rest: NDArray[np.float32], weights: NDArray[np.float64], options: Writing) -> NDArray[np.float32]:
    """The step of the harmonics of each Gaussian, [N] levels; 1 for all where bits are given, or all are kept."""
    most = LARGEST_STEP[options.quality]
    if options.sh_bits or most == 1 or not rest.shape[1]:
        return np.ones(len(rest), np.float32)
    return steps(weights, usual_step(rest, *MEDIAN_STEP[options.quality]), most)


def _rounded_sh(
    p: Parameters, sh_steps: NDArray[np.float32], bits: tuple[int, int] | None
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Harmonics as levels, 128 for 0: multiples of each Gaussian's step, or of 2^(8 - bits); and band 0, which takes up
    the errors of the first."""
    rest = p["sh_rest"]
    levels = np.clip(rest, -1, 1) * np.float32(128)
    if bits is None and sh_steps.max(initial=1) > 1:
        form = visible_form(rest)
        found = np.clip(rounded_rows(levels, sh_steps, form), -128, 128 - sh_steps[:, None])
        base = base_for(p["sh_base"], rest - found / 128, form)
    else:
        columns = np.full(rest.shape[1], 2.0 ** (8 - (bits or WHOLE)[1]), np.float32)
        columns[:9] = 2.0 ** (8 - (bits or WHOLE)[0])
        found, base = np.rint(levels / columns) * columns, p["sh_base"]
    return np.asarray(np.clip(found + 128, 0, 255), np.uint8), base
