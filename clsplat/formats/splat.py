"""Read and write `.splat` of antimatter15, 32 bytes per splat; read `.ksplat` of GaussianSplats3D.

    position 3 float32 · linear scale 3 float32 · r g b a uint8: 255 (1/2 + C0 f_dc), 255 opacity
    quaternion w x y z uint8: 128 q + 128, q of unit length

The largest and most opaque splats come first, for viewers that show a file while it downloads.
"""

import logging
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.reading import read_file
from clsplat.formats.packing import exceeds_byte, warn_clipped, write_bytes
from clsplat.formats.splats import (
    MAX_FILE,
    SH_C0,
    Parameters,
    SplatFile,
    WriteOptions,
    concatenate,
    logits,
    logs,
    normalize_quats,
    opacities,
    reorder_columns,
    require_gaussians,
    require_memory,
    require_size,
    scales_to_logs,
    sh_coefficients,
)

LOG = logging.getLogger("clsplat")
ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
MAX_SCALE = 1e6  # scene units; text misread as numbers has larger values
EXPECTED = "a .splat file with 32 bytes per splat"


def looks_like_splat(data: bytes, size: int) -> bool:
    """Return whether a file of `size` bytes that starts with `data` may be a `.splat`, which has no magic number."""
    count = len(data) // ROW.itemsize
    if not count or size % ROW.itemsize or data.isascii():
        return False
    rows = np.frombuffer(data, ROW, count)
    if not np.isfinite(rows["position"]).all():
        return False
    scale = rows["scale"]
    return bool((np.isfinite(scale) & (scale >= 0) & (scale < MAX_SCALE)).all() and scale.any())


def read_splat(path: Path) -> SplatFile:
    """Read a `.splat` file.  Raises DataError if it is missing, or its size is not a multiple of 32 bytes."""
    data = read_file(path, EXPECTED, limit=MAX_FILE)
    if len(data) % ROW.itemsize:
        raise DataError(f"{path}: has {len(data)} bytes, not a multiple of 32; expected {EXPECTED}; copy it again")
    rows = np.frombuffer(data, ROW)
    require_memory(path, len(rows), 0)
    notes: set[str] = set()
    color = rows["color"] / 255.0
    parameters: Parameters = {
        "means": rows["position"].astype(np.float32),
        "quats": normalize_quats(rows["rotation"] / 128.0 - 1).astype(np.float32),
        "log_scales": scales_to_logs(rows["scale"], notes),
        "logit_opacity": logits(color[:, 3:]),
        "sh_base": ((color[:, :3] - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": np.zeros((len(rows), 0), np.float32),
    }
    if (rows["scale"] < 0).any() and not notes:
        raise DataError(f"{path}: has scales below 0; expected {EXPECTED}; the file may be in another format")
    for note in notes:
        LOG.warning("%s: %s", path, note)
    return SplatFile(parameters)


def write_splat(path: Path, splats: SplatFile, options: WriteOptions) -> str:
    """Write a `.splat` file; return its SHA-256.  Raises DataError for a model without Gaussians, and OutputError."""
    require_gaussians(path, splats)
    p = splats.parameters
    alpha = opacities(p["logit_opacity"])
    volume = p["log_scales"].astype(np.float64).sum(axis=1)
    with np.errstate(divide="ignore"):
        order = np.argsort(-(volume + np.log(alpha[:, 0])), kind="stable")
    rows = np.zeros(len(splats), ROW)
    rows["position"] = p["means"]
    with np.errstate(over="ignore"):
        rows["scale"] = np.minimum(np.exp(p["log_scales"].astype(np.float64)), MAX_SCALE / 2)
    color = np.concatenate([p["sh_base"].astype(np.float64) * SH_C0 + 0.5, alpha], axis=1)
    warn_clipped(path, "splat", "colors from 0 to 1", exceeds_byte(255 * color))
    if p["sh_rest"].shape[1]:
        LOG.warning(
            "%s: .splat stores no SH coefficients, so colors do not depend on the view; other formats store them", path
        )
    rows["color"] = np.clip(np.rint(255 * color), 0, 255)
    rows["rotation"] = np.clip(np.rint(128 * normalize_quats(p["quats"]) + 128), 0, 255)
    return write_bytes(path, rows[order].tobytes())


# `.ksplat` of GaussianSplats3D, read only: a header, then sections, each with buckets and splats.

HEADER, SECTION = 4096, 1024  # bytes of the file's header, and of each section's header
MAX_DEGREE = 2
SH_RANGE = (-1.5, 1.5)
RANGE = 32767
# types of position, of scale and rotation, and of SH, for each compression level
FIELD_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))


@dataclass(frozen=True)
class SplatSection:
    """The header of one section, and the layout of its splats."""

    count: int
    rows: int  # number of stored rows, at least `count`
    degree: int
    bucket_size: int
    buckets: int
    block: float  # side of a bucket, scene units
    bucket_bytes: int
    range: int
    full_buckets: int
    partial_buckets: int

    @classmethod
    def parse(cls, data: bytes, start: int) -> "SplatSection":
        """Parse the header at byte offset `start`."""
        values = struct.unpack_from("<4IfH2x4IH", data, start)
        count, rows, size, buckets, block, bucket_bytes, scale, _, full, partial, degree = values
        return cls(count, rows, degree, size, buckets, block, bucket_bytes, scale or RANGE, full, partial)

    def row_dtype(self, level: int) -> np.dtype[Any]:
        """Return the layout of one splat at a compression level."""
        position, scale, sh = FIELD_TYPES[level]
        fields: list[Any] = [("position", position, 3), ("scale", scale, 3), ("rotation", scale, 4)]
        fields += [("color", "u1", 4), ("sh", sh, 3 * (sh_coefficients(self.degree) - 1))]
        return np.dtype(fields)

    def sizes(self, level: int) -> tuple[int, int, int]:
        """Return the sizes in bytes of the counts of partial buckets, of the buckets, and of the splats."""
        return 4 * self.partial_buckets, self.bucket_bytes * self.buckets, self.row_dtype(level).itemsize * self.rows


def looks_like_ksplat(data: bytes, size: int) -> bool:
    """Return whether a file of `size` bytes that starts with `data` may be a `.ksplat`, which has no magic number."""
    if size < HEADER + SECTION or len(data) < HEADER or data[0] != 0 or not 1 <= data[1] < 32:
        return False
    max_sections, sections, _, splats, level = struct.unpack_from("<4IH", data, 4)
    return bool(sections <= max_sections <= size // SECTION and level < len(FIELD_TYPES) and 0 < splats <= size // 24)


def read_ksplat(path: Path) -> SplatFile:
    """Read a `.ksplat` file.  Raises DataError if it is missing or damaged."""
    data = read_file(path, "a .ksplat file", limit=MAX_FILE)
    max_sections, sections, _, splats, level = struct.unpack_from("<4IH", data.ljust(HEADER, b"\xff"), 4)
    if len(data) >= HEADER and not data[0] and not sections + splats:
        raise DataError(f"{path}: has no splats; export it again")
    if not looks_like_ksplat(data, len(data)):
        raise DataError(f"{path}: not a .ksplat file of version 0.1 with a header of {HEADER} bytes; copy it again")
    sections = sections or max_sections  # `sections` counts the sections loaded so far; some writers leave it at 0
    sh_range = struct.unpack_from("<2f", data, 36)
    start = HEADER + SECTION * max_sections
    require_size(path, len(data), start, f"{max_sections} sections")
    parts = []
    for index in range(sections):
        section = SplatSection.parse(data, HEADER + SECTION * index)
        _check_section(path, section, index)
        sizes = section.sizes(level)
        require_size(path, len(data), start + sum(sizes), f"{section.rows} splats in section {index}")
        require_memory(path, section.count, section.degree)
        parts.append(_decode_section(path, data, start, section, level, sh_range if any(sh_range) else SH_RANGE))
        start += sum(sizes)
    return SplatFile(concatenate(parts))


def _check_section(path: Path, section: SplatSection, index: int) -> None:
    """Raise DataError for an invalid section."""
    if section.degree > MAX_DEGREE or section.count > section.rows:
        raise DataError(
            f"{path}: section {index} has {section.count} splats in {section.rows} rows, SH degree {section.degree}; "
            f"expected no more splats than rows, and degree 0 to {MAX_DEGREE}; the file is damaged: copy it again"
        )
    bucket_count = section.full_buckets + section.partial_buckets
    if (section.buckets and section.bucket_bytes < 12) or bucket_count > section.buckets:
        raise DataError(f"{path}: the buckets of section {index} do not match their counts; copy the file again")


def _decode_section(
    path: Path, data: bytes, start: int, section: SplatSection, level: int, sh_range: tuple[float, ...]
) -> dict[str, NDArray[np.float32]]:
    """Return the parameters of one section."""
    partial, buckets, _ = section.sizes(level)
    rows = np.frombuffer(data, section.row_dtype(level), section.count, start + partial + buckets)
    position = rows["position"].astype(np.float64)
    if level and section.count:
        position = (position - section.range) * (section.block / 2 / section.range)
        position += _bucket_centers(path, data, start, section)
    sh = rows["sh"].astype(np.float64)
    if level == 2:
        sh = sh_range[0] + sh / 255 * (sh_range[1] - sh_range[0])
    color = rows["color"] / 255.0
    with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite are rejected later
        bands = [band.astype(np.float32) for band in np.split(sh, [9], axis=1)]  # channel-major, for each degree
        return {
            "means": position.astype(np.float32),
            "quats": rows["rotation"].astype(np.float32),
            "log_scales": logs(rows["scale"]),
            "logit_opacity": logits(color[:, 3:]),
            "sh_base": ((color[:, :3] - 0.5) / SH_C0).astype(np.float32),
            "sh_rest": np.hstack([reorder_columns(band, 3, band.shape[1] // 3) for band in bands]),
        }


def _bucket_centers(path: Path, data: bytes, start: int, section: SplatSection) -> NDArray[np.float64]:
    """Return the center of each splat's bucket, [count, 3]; full buckets come first, then partial ones."""
    partial = np.frombuffer(data, "<u4", section.partial_buckets, start).astype(np.int64)
    full_count = section.full_buckets * section.bucket_size
    if full_count + int(partial.sum()) < section.count or full_count > section.rows:
        raise DataError(f"{path}: its buckets contain fewer than the declared {section.count} splats; copy it again")
    counts = np.concatenate([np.full(section.full_buckets, section.bucket_size), np.minimum(partial, section.count)])
    ends = np.minimum(np.cumsum(counts), section.count)
    bucket = np.repeat(np.arange(len(counts)), np.diff(ends, prepend=0))
    table = np.frombuffer(data, "u1", section.bucket_bytes * section.buckets, start + 4 * section.partial_buckets)
    centers = table.reshape(section.buckets, section.bucket_bytes)[:, :12].copy().view("<f4")
    return centers[bucket].astype(np.float64)
