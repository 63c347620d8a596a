"""`.splat` of antimatter15: 32 bytes a splat, no header, no harmonics.

    position 3 float32 · linear scale 3 float32 · r g b a uint8: 255 (1/2 + C0 f_dc), 255 opacity
    quaternion w x y z uint8: 128 q + 128, q of unit length

The largest and most opaque come first, for viewers that show a file while it arrives.
"""

import logging
from pathlib import Path

import numpy as np

from clsplat.errors import DataError
from clsplat.formats.output import written
from clsplat.formats.packing import beyond_bytes, tell_cut
from clsplat.formats.splats import (
    MAX_FILE,
    SH_C0,
    Parameters,
    SplatFile,
    Writing,
    logits,
    logs,
    opacities,
    require_some,
    unit,
)
from clsplat.reading import read_file

LOG = logging.getLogger("clsplat")
ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])
LARGEST_SCALE = 1e6  # scene units: text, read as numbers, has larger ones
EXPECTED = "a .splat file, 32 bytes a splat"


def looks_like_splat(data: bytes, size: int) -> bool:
    """Return whether bytes that begin a file of a size can be splats: the format has no mark."""
    count = len(data) // ROW.itemsize
    if not count or size % ROW.itemsize or data.isascii():
        return False
    rows = np.frombuffer(data, ROW, count)
    if not np.isfinite(rows["position"]).all():
        return False
    scale = rows["scale"]
    return bool((np.isfinite(scale) & (scale >= 0) & (scale < LARGEST_SCALE)).all() and scale.any())


def read_splat(path: Path) -> SplatFile:
    """Read a `.splat` file.  Raises DataError when it is missing or has another size."""
    data = read_file(path, EXPECTED, limit=MAX_FILE)
    if len(data) % ROW.itemsize:
        raise DataError(f"{path}: has {len(data)} bytes, no multiple of 32; expected {EXPECTED}: copy it again")
    rows = np.frombuffer(data, ROW)
    if (rows["scale"] < 0).any():
        raise DataError(f"{path}: holds scales below 0; expected {EXPECTED}: it may be a file of another format")
    colour = rows["colour"] / 255.0
    parameters: Parameters = {
        "means": rows["position"].astype(np.float32),
        "quats": unit(rows["rotation"] / 128.0 - 1).astype(np.float32),
        "log_scales": logs(rows["scale"]),
        "logit_opacity": logits(colour[:, 3:]),
        "sh_base": ((colour[:, :3] - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": np.zeros((len(rows), 0), np.float32),
    }
    return SplatFile(parameters)


def write_splat(path: Path, splats: SplatFile, options: Writing) -> str:
    """Write a `.splat` file.  Raises DataError for a model without Gaussians, OutputError."""
    require_some(path, splats)
    p = splats.parameters
    alpha = opacities(p["logit_opacity"])
    volume = p["log_scales"].astype(np.float64).sum(axis=1)
    with np.errstate(divide="ignore"):
        order = np.argsort(-(volume + np.log(alpha[:, 0])), kind="stable")
    rows = np.zeros(len(splats), ROW)
    rows["position"] = p["means"]
    with np.errstate(over="ignore"):
        rows["scale"] = np.minimum(np.exp(p["log_scales"].astype(np.float64)), LARGEST_SCALE / 2)
    colour = np.concatenate([p["sh_base"].astype(np.float64) * SH_C0 + 0.5, alpha], axis=1)
    tell_cut(path, "splat", "colours from 0 to 1", beyond_bytes(255 * colour))
    if p["sh_rest"].shape[1]:
        LOG.warning(
            "%s: splat holds no harmonics: the colours are the same from everywhere; other formats hold them", path
        )
    rows["colour"] = np.clip(np.rint(255 * colour), 0, 255)
    rows["rotation"] = np.clip(np.rint(128 * unit(p["quats"]) + 128), 0, 255)
    with written(path) as file:
        file.write(rows[order].tobytes())
    return file.sha256
