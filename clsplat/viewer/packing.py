"""Pack a model into bytes that a page decodes: a header, and planes, each of which holds one component of all splats.

    tables    [4, 256] float32: values of scale, opacity, color of band 0, and color of the other bands
    blocks    [B, 6] float32: for each BLOCK consecutive splats, the smallest t of x, y, z, then the steps of t
    positions [6, N] uint8: low bytes of x, y, z, then high bytes; t = smallest + step · (low + 256 high); a position
              is origin + unit · sign(t) (e^|t| - 1), so that precision falls with the distance from the center
    quats     [N] uint32: index of the largest component in bits 31-30; the other three in order, 10 bits each
    scales    [3, N], opacity [1, N], colors [3 K, N] uint8: indices into the tables; colors are ordered
              by coefficient, then channel
    motion    [columns, N] float16, only of moving models: the columns of clsplat/formats/splats.py, with rotations
              as changes of the unit quaternion above, in the order x, y, z, w

All values are little-endian.  Splats are sorted into LEVELS parts of decreasing importance, so that the first parts
show a coarse scene.  Within a part, splats follow a space-filling curve, which keeps the blocks small.
"""

import gzip
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import size_text
from clsplat.formats.packing import morton_order, smallest_three
from clsplat.formats.splats import MAX_LOG, motion_degree, motion_fields
from clsplat.gaussians.conversion import with_sky_splats
from clsplat.gaussians.model import Model

BLOCK = 256  # splats
LEVELS = 8
MIN_OPACITY = 1 / 255  # fainter Gaussians are never drawn (ALPHA_MIN in cl_kernels/common.h)
MIN_NORM2 = 1e-12  # shorter quaternions have no direction (QUAT_NORM2_MIN)
MAX_LOG_RATIO = 9.0  # largest log ratio of scales; flatter Gaussians look the same under the screen filter
STEPS = 2**14 - 1  # across a block
RANK_WEIGHT = 0.25  # weight of ranks, as opposed to values, in the spacing of a table's entries
KNEE = 0.5  # absolute SH coefficient up to which the steps of a table are even; beyond it, they grow
MIN_RANGE = 3.0  # smallest range of that table; steps finer than 0.01 cost bytes and are invisible
BITS = 10  # per component of a quaternion
MAX_HALF = 65504.0  # largest float16

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class PackedModel:
    """The header and the compressed planes of a packed model."""

    header: dict[str, Any]
    data: bytes  # gzip of the planes

    @property
    def count(self) -> int:
        """The number of splats in the data."""
        return int(self.header["count"])

    @property
    def count_text(self) -> str:
        """The number of splats as text: "8,389 Gaussians and 10,000 of the sky"."""
        faint_count, sky_count = self.header["faint"], self.header.get("sky", 0)
        text = size_text(self.count - sky_count, None, sky_count)
        return text + (f" + {faint_count:,} too faint to draw" if faint_count else "")


def pack(model: Model, limit: int | None = None, sky_center: NDArray[np.floating] | None = None) -> PackedModel:
    """Pack a model and the Gaussians of its sky.  The same model gives the same bytes.

    limit: maximum number of splats; if the model has more, the most important ones are kept; None keeps all.
    sky_center: as in `with_sky_splats`.
    """
    scene_count = len(model)
    model = with_sky_splats(model, center=sky_center).baked()
    faint_count = int((model.opacities <= MIN_OPACITY).sum()) if limit is None or limit >= len(model) else 0
    order = _draw_order(model, limit)
    sky_count = int((order >= scene_count).sum())
    model = model[order]
    frame = _find_frame(model.means.astype(np.float64))
    count = len(model)
    logs = model.log_scales.astype(np.float64)
    logs = np.maximum(logs, logs.max(axis=1, keepdims=True) - MAX_LOG_RATIO)
    scales, opacity, base = (_value_table(values) for values in (logs, model.opacities, model.sh_base))
    rest = _quantization_table(float(max(model.sh_rest.max(initial=0.0), -model.sh_rest.min(initial=0.0))))
    tables = np.stack([np.exp(np.minimum(scales, MAX_LOG)), opacity, base, rest]).astype("<f4")
    planes: list[NDArray[Any]] = [tables, *_pack_positions(_logarithmic(model.means, *frame)), _pack_quats(model.quats)]
    pairs = (scales, logs), (opacity, model.opacities[:, None]), (base, model.sh_base), (rest, model.sh_rest)
    planes += [_nearest_indices(table, column) for table, values in pairs for column in values.T]
    header = {
        "count": count,
        "faint": faint_count,  # Gaussians too faint to draw; without a limit, a valid model loses only these
        **({"sky": sky_count} if sky_count else {}),
        "degree": model.sh_degree,
        "near": model.near,
        "variance": model.rendering.screen_variance,
        "compensate": model.rendering.compensate,
        **({"box": 1} if model.rendering.pixel_box else {}),
        "origin": frame[0].tolist(),
        "unit": frame[1],
        "levels": [count * (level + 1) // LEVELS for level in range(LEVELS)],
    }
    if model.motion is not None:
        planes.append(_pack_motion(model.motion, model.quats))
        header["motion"] = _motion_header(model.motion.shape[1])
    data = b"".join(np.ascontiguousarray(plane).tobytes() for plane in planes)
    return PackedModel(header, gzip.compress(data, 7, mtime=0))


def _visible_indices(model: Model) -> NDArray[np.intp]:
    """Return the indices of Gaussians that have finite values, a nonzero quaternion, and enough opacity to be drawn."""
    is_finite = np.logical_and.reduce([np.isfinite(table).all(axis=1) for table in model.tables().values()])
    has_direction = (model.quats.astype(np.float64) ** 2).sum(axis=1) >= MIN_NORM2
    return np.flatnonzero(is_finite & has_direction & (model.opacities > MIN_OPACITY))


def _draw_order(model: Model, limit: int | None) -> NDArray[np.intp]:
    """Return the indices of at most `limit` visible Gaussians, in LEVELS parts of decreasing importance.

    Each part is in Morton order.
    """
    indices = _visible_indices(model)
    means = model.means[indices].astype(np.float64)
    areas = np.sort(model.log_scales[indices].astype(np.float64), axis=1)[:, 1:].sum(axis=1)
    by_importance = np.argsort(-(areas + np.log(model.opacities[indices].astype(np.float64))), kind="stable")[:limit]
    points = _logarithmic(means, *_find_frame(means))
    borders = [len(by_importance) * level // LEVELS for level in range(LEVELS + 1)]
    parts = [by_importance[begin:end] for begin, end in itertools.pairwise(borders)]
    return np.asarray(indices[np.concatenate([part[morton_order(points[part])] for part in parts])])


def _find_frame(means: Floats) -> tuple[Floats, float]:
    """Return the median position, [3], and the median absolute deviation over all axes, rounded to float32."""
    if not len(means):
        return np.zeros(3), 1.0
    origin = np.median(means, axis=0).astype(np.float32).astype(np.float64)
    return origin, float(np.float32(np.median(np.abs(means - origin)))) or 1.0


def _logarithmic(means: NDArray[np.floating], origin: Floats, unit: float) -> Floats:
    """Return the logarithmic coordinates of positions, [N, 3]: sign(d) log(1 + |d|), d = (position - origin) / unit."""
    offsets = (means.astype(np.float64) - origin) / unit
    return np.asarray(np.sign(offsets) * np.log1p(np.abs(offsets)))


def _pack_positions(means: Floats) -> tuple[NDArray[np.float32], Bytes]:
    """Return the smallest coordinates and step sizes of blocks, [B, 6], and the coordinates in steps, [6, N] bytes."""
    starts = np.arange(0, len(means), BLOCK)
    low = np.minimum.reduceat(means, starts) if len(means) else np.empty((0, 3))
    high = np.maximum.reduceat(means, starts) if len(means) else np.empty((0, 3))
    blocks = np.hstack([low, (high - low) / STEPS]).astype("<f4")
    bounds = blocks.astype(np.float64)[np.arange(len(means)) // BLOCK]  # rounded to float32, as the page reads them
    steps = np.where(bounds[:, 3:] > 0, bounds[:, 3:], 1.0)
    codes = np.rint((means - bounds[:, :3]) / steps).clip(0, STEPS).astype(np.uint16).T
    return blocks, np.concatenate([codes & 255, codes >> 8]).astype(np.uint8)


def _pack_quats(quats: NDArray[np.float32]) -> NDArray[np.unsignedinteger]:
    """Return the packed unit quaternions, [N], each with the sign that makes its largest component positive."""
    rolled = np.roll(quats.astype(np.float64), -1, axis=1)
    rolled /= np.linalg.norm(rolled, axis=1, keepdims=True)
    largest_index, others = smallest_three(rolled)
    max_code = 2**BITS - 1
    codes = np.rint((others * np.sqrt(0.5) + 0.5) * max_code).clip(0, max_code).astype(np.uint32)
    shifts = np.array([2 * BITS, BITS, 0], np.uint32)
    words = (codes << shifts).sum(axis=1, dtype=np.uint32) | (largest_index.astype(np.uint32) << np.uint32(30))
    return np.asarray(words, "<u4")


def _pack_motion(motion: NDArray[np.floating], quats: NDArray[np.floating]) -> NDArray[np.float16]:
    """Return the columns of the motion, [columns, N], with rotations relative to the stored quaternions."""
    columns = motion.astype(np.float64)
    if (rotation := motion_fields(motion.shape[1]).get("turn")) is not None:
        rolled = np.roll(quats.astype(np.float64), -1, axis=1)
        largest_component = np.take_along_axis(rolled, np.abs(rolled).argmax(axis=1)[:, None], axis=1)
        norm = np.linalg.norm(rolled, axis=1, keepdims=True) * np.where(largest_component < 0, -1.0, 1.0)
        columns[:, rotation] = np.roll(columns[:, rotation], -1, axis=1) / norm
    return columns.clip(-MAX_HALF, MAX_HALF).astype("<f2").T


def _motion_header(columns: int) -> dict[str, int]:
    """Return the numbers of columns and of terms of degree 2 or more, and the index of the first rotation column.

    The index is 0 if the motion has no rotation.
    """
    rotation = motion_fields(columns).get("turn")
    return {"columns": columns, "bends": motion_degree(columns) - 1, "turns": rotation.start if rotation else 0}


def _value_table(values: NDArray[np.floating]) -> Floats:
    """Return a table of 256 ascending values that follow the distribution of `values`."""
    sorted_values = np.sort(np.asarray(values, np.float64), axis=None)
    if not len(sorted_values) or sorted_values[0] == sorted_values[-1]:
        return np.full(256, sorted_values[0] if len(sorted_values) else 0.0)
    by_rank = np.linspace(0, 1, len(sorted_values))
    by_value = (sorted_values - sorted_values[0]) / (sorted_values[-1] - sorted_values[0])
    position = RANK_WEIGHT * by_rank + (1 - RANK_WEIGHT) * by_value
    return np.interp(np.linspace(0, 1, 256), position, sorted_values)


def _quantization_table(max_value: float) -> Floats:
    """Return a table of 256 values around 0: even steps up to KNEE, then growing steps up to `max_value`."""
    values = KNEE * np.sinh(np.linspace(-1, 1, 255) * np.arcsinh(max(MIN_RANGE, max_value) / KNEE))
    values[127] = 0.0
    return np.append(values, values[-1])


def _nearest_indices(table: Floats, values: NDArray[np.floating]) -> Bytes:
    """Return the index of the nearest table value for each value, in the shape of `values`."""
    borders = (table[1:] + table[:-1]) / 2
    return np.searchsorted(borders, values).astype(np.uint8)
