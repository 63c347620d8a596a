"""The planes of a packed model as NumPy tables: what data.js and the shaders make of them, in float64."""

import gzip
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clsplat.viewer.packing import BLOCK, PackedModel


@dataclass
class Unpacked:
    """N splats."""

    means: NDArray[np.float64]  # [N, 3]
    quats: NDArray[np.float64]  # [N, 4] (w, x, y, z), unit
    scales: NDArray[np.float64]  # [N, 3]
    opacities: NDArray[np.float64]  # [N]
    sh: NDArray[np.float64]  # [N, K, 3]
    motion: NDArray[np.float64]  # [N, columns]


def unpacked(packed: PackedModel) -> Unpacked:
    count, raw, place = packed.count, gzip.decompress(packed.data), 0

    def take(kind: str, *shape: int) -> NDArray[np.float64]:
        nonlocal place
        part = np.frombuffer(raw, kind, int(np.prod(shape)), place).reshape(shape)
        place += part.nbytes
        return part

    coefficients = (packed.header["degree"] + 1) ** 2
    scale, opacity, base, rest = take("<f4", 4, 256).astype(np.float64)
    own = take("<f4", -(-count // BLOCK), 6).astype(np.float64)[np.arange(count) // BLOCK]
    steps = take("u1", 6, count).astype(np.float64)
    words = take("<u4", count)
    shapes, opacities = take("u1", 3, count), take("u1", count)
    codes = take("u1", coefficients, 3, count)
    motion = take("<f2", packed.header.get("motion", {"columns": 0})["columns"], count)
    assert place == len(raw)
    others = (np.stack([words >> 20, words >> 10, words], 1) % 1024 / 1023 - 0.5) * np.sqrt(2)
    largest = np.arange(4) == (words >> 30)[:, None]
    unit = np.empty((count, 4))
    unit[~largest] = others.ravel()
    unit[largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    sh = np.concatenate([base[codes[:1]], rest[codes[1:]]]).transpose(2, 0, 1)
    t = own[:, :3] + own[:, 3:] * (steps[:3] + 256 * steps[3:]).T
    means = packed.header["origin"] + packed.header["unit"] * np.sign(t) * np.expm1(np.abs(t))
    return Unpacked(
        means, np.roll(unit, 1, axis=1), scale[shapes].T, opacity[opacities], sh, motion.T.astype(np.float64)
    )
