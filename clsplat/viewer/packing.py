"""A model as bytes that a page decodes: a header, and planes of one component of all splats each.

    tables    [4, 256] float32: scale, opacity, color of band 0, color of the other bands; bytes below are indices
    blocks    [B, 6] float32: least t of x, y, z, then step, of BLOCK splats that follow each other
    positions [6, N] uint8: low bytes of x, y, z, then high bytes; t = least + step · (low + 256 high), and a position
              is origin + unit · sign(t) (e^|t| - 1): as fine as cameras in the middle see it, near and far
    quats     [N] uint32: index of the largest component in bits 31-30, the others, from x on, 10 bits each
    scales    [3, N], opacity [1, N], colors [3 K, N] uint8: indices; colors by coefficient, then channel
    motion    [columns, N] float16, where the model moves: those of clsplat/formats/splats.py, the turn as change of
              the unit quaternion above, x, y, z, w

All numbers are little-endian.  Splats stand in LEVELS parts of falling importance, so that the first parts alone show
the scene coarsely; in a part they follow a curve through space, which keeps blocks small.
"""

import gzip
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.packing import morton_order, smallest_three
from clsplat.formats.splats import MAX_LOG, fields_of, motion_degree_of
from clsplat.gaussians.model import Model

BLOCK = 256  # splats
LEVELS = 8
MIN_OPACITY = 1 / 255  # fainter Gaussians are never drawn (ALPHA_MIN of cl_kernels/common.h)
MIN_NORM2 = 1e-12  # shorter quaternions have no direction (QUAT_NORM2_MIN)
FLATTEST = 9.0  # log of the largest by the smallest scale: thinner ones look the same under the screen filter
STEPS = 2**14 - 1  # of a block's extent
RANK_SHARE = 0.25  # of a table's spacing; the rest is by value
KNEE = 0.5  # of colors of bands above 0: below it the table is even, above it logarithmic
LEAST_RANGE = 3.0  # of that table: finer steps than of 0.01 cost bytes and show nothing
BITS = 10  # of a component of a quaternion
MAX_HALF = 65504.0  # of half floats

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Packed:
    """A model for a page."""

    header: dict[str, Any]
    data: bytes  # gzip of the planes

    @property
    def count(self) -> int:
        """Number of splats; those that no view shows are left out."""
        return int(self.header["count"])


def pack(model: Model, limit: int | None = None) -> Packed:
    """Return a model as bytes; the same model gives the same bytes.

    limit: the number of splats, the most important ones; None: all.
    """
    model = model.baked()
    faint = int((model.opacities <= MIN_OPACITY).sum()) if limit is None or limit >= len(model) else 0
    model = model[_order(model, limit)]
    frame = _frame(model.means.astype(np.float64))
    count = len(model)
    logs = model.log_scales.astype(np.float64)
    logs = np.maximum(logs, logs.max(axis=1, keepdims=True) - FLATTEST)
    scales, opacity, base = (_table(values) for values in (logs, model.opacities, model.sh_base))
    rest = _even_table(float(max(model.sh_rest.max(initial=0.0), -model.sh_rest.min(initial=0.0))))
    tables = np.stack([np.exp(np.minimum(scales, MAX_LOG)), opacity, base, rest]).astype("<f4")
    planes: list[NDArray[Any]] = [tables, *_positions(_logarithmic(model.means, *frame)), _quaternions(model.quats)]
    columns = (scales, logs), (opacity, model.opacities[:, None]), (base, model.sh_base), (rest, model.sh_rest)
    planes += [_codes(table, column) for table, values in columns for column in values.T]
    header = {
        "count": count,
        "faint": faint,  # too faint to draw: all that is left out of a model without faults, if there is no limit
        "degree": model.sh_degree,
        "near": model.rendering.near,
        "variance": model.rendering.screen_variance,
        "compensate": model.rendering.compensate,
        **({"box": 1} if model.rendering.pixel_box else {}),
        "origin": frame[0].tolist(),
        "unit": frame[1],
        "levels": [count * (level + 1) // LEVELS for level in range(LEVELS)],
    }
    if model.motion is not None:
        planes.append(_motion(model.motion, model.quats))
        header["motion"] = _motion_header(model.motion.shape[1])
    data = b"".join(np.ascontiguousarray(plane).tobytes() for plane in planes)
    return Packed(header, gzip.compress(data, 7, mtime=0))


def _drawn(model: Model) -> NDArray[np.intp]:
    """Indices of the Gaussians that some view shows."""
    finite = np.logical_and.reduce([np.isfinite(table).all(axis=1) for table in model.tables().values()])
    direction = (model.quats.astype(np.float64) ** 2).sum(axis=1) >= MIN_NORM2
    return np.flatnonzero(finite & direction & (model.opacities > MIN_OPACITY))


def _order(model: Model, limit: int | None) -> NDArray[np.intp]:
    """Indices by falling importance in LEVELS parts, and along a curve in each; without what no view shows."""
    drawn = _drawn(model)
    means = model.means[drawn].astype(np.float64)
    areas = np.sort(model.log_scales[drawn].astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    ranked = np.argsort(-(areas + np.log(model.opacities[drawn].astype(np.float64))), kind="stable")[:limit]
    points = _logarithmic(means, *_frame(means))
    borders = [len(ranked) * level // LEVELS for level in range(LEVELS + 1)]
    parts = [ranked[begin:end] for begin, end in itertools.pairwise(borders)]
    return np.asarray(drawn[np.concatenate([part[morton_order(points[part])] for part in parts])])


def _frame(means: Floats) -> tuple[Floats, float]:
    """The middle of points, [3], and their median distance from it along an axis, as single precision holds them."""
    if not len(means):
        return np.zeros(3), 1.0
    origin = np.median(means, axis=0).astype(np.float32).astype(np.float64)
    return origin, float(np.float32(np.median(np.abs(means - origin)))) or 1.0


def _logarithmic(means: NDArray[np.floating], origin: Floats, unit: float) -> Floats:
    """The coordinates that are stored in steps, [N, 3]."""
    offsets = (means.astype(np.float64) - origin) / unit
    return np.asarray(np.sign(offsets) * np.log1p(np.abs(offsets)))


def _positions(means: Floats) -> tuple[NDArray[np.float32], Bytes]:
    """Least coordinate and step of each block, [B, 6], and the bytes of whole steps, [6, N]."""
    starts = np.arange(0, len(means), BLOCK)
    least = np.minimum.reduceat(means, starts) if len(means) else np.empty((0, 3))
    most = np.maximum.reduceat(means, starts) if len(means) else np.empty((0, 3))
    blocks = np.hstack([least, (most - least) / STEPS]).astype("<f4")
    own = blocks.astype(np.float64)[np.arange(len(means)) // BLOCK]  # rounded, as the page reads them
    steps = np.where(own[:, 3:] > 0, own[:, 3:], 1.0)
    codes = np.rint((means - own[:, :3]) / steps).clip(0, STEPS).astype(np.uint16).T
    return blocks, np.concatenate([codes & 255, codes >> 8]).astype(np.uint8)


def _quaternions(quats: NDArray[np.float32]) -> NDArray[np.unsignedinteger]:
    """The three smaller components of unit quaternions (x, y, z, w), the largest made positive, [N]."""
    unit = np.roll(quats.astype(np.float64), -1, axis=1)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    largest, others = smallest_three(unit)
    top = 2**BITS - 1
    codes = np.rint((others * np.sqrt(0.5) + 0.5) * top).clip(0, top).astype(np.uint32)
    shifts = np.array([2 * BITS, BITS, 0], np.uint32)
    packed = (codes << shifts).sum(axis=1, dtype=np.uint32) | (largest.astype(np.uint32) << np.uint32(30))
    return np.asarray(packed, "<u4")


def _motion(motion: NDArray[np.floating], quats: NDArray[np.floating]) -> NDArray[np.float16]:
    """The columns of the motion, [columns, N]; the turn that of the quaternion which is stored."""
    columns = motion.astype(np.float64)
    if (turn := fields_of(motion.shape[1]).get("turn")) is not None:
        unit = np.roll(quats.astype(np.float64), -1, axis=1)
        largest = np.take_along_axis(unit, np.abs(unit).argmax(axis=1)[:, None], axis=1)
        norm = np.linalg.norm(unit, axis=1, keepdims=True) * np.where(largest < 0, -1.0, 1.0)
        columns[:, turn] = np.roll(columns[:, turn], -1, axis=1) / norm
    return columns.clip(-MAX_HALF, MAX_HALF).astype("<f2").T


def _motion_header(columns: int) -> dict[str, int]:
    """What the page needs to know of the columns: their number, that of the powers above the first, and the turn's."""
    turn = fields_of(columns).get("turn")
    return {"columns": columns, "bends": motion_degree_of(columns) - 1, "turns": turn.start if turn else 0}


def _table(values: NDArray[np.floating]) -> Floats:
    """256 ascending values, as dense as `values` are, but in no place too far apart."""
    ordered = np.sort(np.asarray(values, np.float64), axis=None)
    if not len(ordered) or ordered[0] == ordered[-1]:
        return np.full(256, ordered[0] if len(ordered) else 0.0)
    by_rank = np.linspace(0, 1, len(ordered))
    by_value = (ordered - ordered[0]) / (ordered[-1] - ordered[0])
    place = RANK_SHARE * by_rank + (1 - RANK_SHARE) * by_value
    return np.interp(np.linspace(0, 1, 256), place, ordered)


def _even_table(most: float) -> Floats:
    """256 values around 0, which is one of them: even steps up to KNEE, then growing ones up to `most`."""
    places = np.linspace(-1, 1, 255) * np.arcsinh(max(LEAST_RANGE, most) / KNEE)
    values = KNEE * np.sinh(places)
    values[127] = 0.0
    return np.append(values, values[-1])


def _codes(table: Floats, values: NDArray[np.floating]) -> Bytes:
    """Indices of the nearest values of a table, with the shape of `values`."""
    borders = (table[1:] + table[:-1]) / 2
    return np.searchsorted(borders, values).astype(np.uint8)
