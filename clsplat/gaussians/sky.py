"""The colors behind the Gaussians by direction: a map on the host, on the device, and in a file beside a model's."""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.files import write_error, write_text
from clsplat.core.reading import read_json, sha256
from clsplat.opencl.device import Array, Device

# The octahedral map: all directions in a square (Meyer et al. 2010), as cl_kernels/sky.cl describes it.

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def signs(directions: NDArray[np.floating]) -> Floats:
    """Return -1 for components below 0 and else 1, [..., 3]."""
    return np.where(directions < 0, -1.0, 1.0)


def texel_positions(directions: NDArray[np.floating], side: int) -> Floats:
    """Return where directions, [..., 3] of any length, lie between the centers of texels, [..., 2] from -0.5 on."""
    directions = np.asarray(directions, np.float64)
    sign = signs(directions)
    below = np.minimum(directions[..., 2:], 0)
    folded = directions[..., :2] - sign[..., :2] * below
    inside = folded / np.abs(directions).sum(axis=-1, keepdims=True)
    return np.asarray((inside + 1) * (side / 2) - 0.5, np.float64)


def texel_directions(side: int) -> Floats:
    """Return the directions of the centers of all texels, unit vectors, [side * side, 3], row by row."""
    centers = (2 * np.arange(side) + 1) / side - 1
    v, u = (axis.ravel() for axis in np.meshgrid(centers, centers, indexing="ij"))
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    found = np.stack([u - np.where(u < 0, -fold, fold), v - np.where(v < 0, -fold, fold), z], axis=1)
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True), np.float64)


def texel_at(i: Integers, j: Integers, side: int) -> Integers:
    """Return the numbers of texels in columns i and rows j, from -1 to `side`: beyond an edge the square goes on at the
    mirrored place of the same edge."""
    beyond = (i < 0) | (i >= side)
    i, j = np.clip(i, 0, side - 1), np.where(beyond, side - 1 - j, j)
    beyond = (j < 0) | (j >= side)
    i, j = np.where(beyond, side - 1 - i, i), np.clip(j, 0, side - 1)
    return j * side + i


def neighbor_texels(side: int) -> Integers:
    """Return the texels about each texel and itself, [side * side, 9]."""
    j, i = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    return np.stack([texel_at(i + right, j + down, side) for down in (-1, 0, 1) for right in (-1, 0, 1)], axis=1)


def bilinear_texels(i: Integers, j: Integers, side: int) -> Integers:
    """Return the four texels about places whose integer parts are i and j, from -1 to side - 1, [..., 4]."""
    return np.stack([texel_at(i + right, j + down, side) for down in (0, 1) for right in (0, 1)], axis=-1)


def bilinear_weights(fractions: Floats) -> Floats:
    """Return the bilinear weights of the four texels, [..., 4], of the fractional parts of places, [..., 2]."""
    a, b = fractions[..., 0], fractions[..., 1]
    return np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=-1)


def sample_texels(texels: NDArray[np.floating], directions: NDArray[np.floating]) -> Floats:
    """Return the values of a map, [side * side, C], in directions [..., 3]: [..., C]."""
    side = int(np.sqrt(len(texels)))
    place = texel_positions(directions, side)
    first = np.floor(place).astype(np.int64)
    found = texels[bilinear_texels(first[..., 0], first[..., 1], side)]
    return np.asarray(np.einsum("...kc,...k->...c", found, bilinear_weights(place - first)))


LOG = logging.getLogger("clsplat")

SIDES = 8, 512  # texels: smallest and largest
MEANING = (
    "colors behind the model by direction, an octahedral map: with s = |x| + |y| + |z| the direction (x, y, z) of the "
    "scene lies at (u, v) = (x, y) / s, where z < 0 at (x - sign(x) z, y - sign(y) z) / s; texels, red, green and "
    "blue, lie row by row at u, v = -1 + (2 i + 1) / side"
)


@dataclass(frozen=True)
class DeviceSky:
    """A map on the device."""

    texels: Array  # [3, side * side]
    side: int

    def host(self) -> "Sky":
        """Copy it to the host."""
        return Sky(np.ascontiguousarray(self.texels.get().T))


@dataclass(frozen=True, eq=False)
class Sky:
    """A map of the colors behind a model."""

    texels: NDArray[np.float32]  # [side * side, 3], row by row

    @property
    def side(self) -> int:
        """Texels in a row."""
        return int(np.sqrt(len(self.texels)))

    def upload(self, device: Device) -> DeviceSky:
        """Copy it to a device."""
        return DeviceSky(device.upload(np.ascontiguousarray(self.texels.T)), self.side)

    def rotated(self, rotation: NDArray[np.floating]) -> "Sky":
        """Return the map of a scene that is turned by x -> rotation x, [3, 3]; colors between texels are bilinear."""
        return Sky(sample_texels(self.texels, texel_directions(self.side) @ rotation).astype(np.float32))

    def write(self, path: Path, models: Mapping[str, str]) -> None:
        """Write it as JSON, with the SHA-256 of the model files that it belongs to, by name; numbers keep their bits.

        Raises OutputError.
        """
        rows = [[float(value) for value in texel] for texel in self.texels]
        own = dict(sorted(models.items()))
        data = {"meaning": MEANING, "type": "directions", "models": own, "side": self.side, "texels": rows}
        write_text(path, json.dumps(data) + "\n")


def sky_path(model: Path) -> Path:
    """Return the file that holds the sky of a model file, where it has one; of one as it was trained, `_raw`, too."""
    return model.with_name(f"{model.stem.removesuffix('_raw')}_sky.json")


def write_sky_file(sky: Sky | None, model: Path, digest: str) -> None:
    """Write the sky of a model file, of that SHA-256, beside it; without a sky, let none that is there belong to it.

    Other model files of the same stem stay with a sky that is the same.  Raises OutputError.
    """
    path = sky_path(model)
    try:
        before, models = _read(path) if path.is_file() else (None, {})
    except DataError:  # which belongs to no model
        before, models = None, {}
    others = {name: one for name, one in models.items() if name != model.name and (sky or one != digest)}
    if sky:
        same = before is not None and np.array_equal(before.texels, sky.texels)
        sky.write(path, {**(others if same else {}), model.name: digest})
    elif before and others:
        before.write(path, others)
    elif before and models:
        try:
            path.unlink()
        except OSError as error:
            raise write_error(path, error) from error


def read_sky_file(model: Path, expected: bool = False) -> Sky | None:
    """Return the sky of a model file; None without one, with a warning where one is expected or is of another model.

    Raises DataError where its file is damaged.
    """
    path = sky_path(model)
    if not path.is_file():
        if expected:
            LOG.warning("%s: was trained with a sky, which is drawn where %s lies beside it", model, path.name)
        return None
    sky, models = _read(path)
    if sha256(model) in models.values():
        return sky
    LOG.warning(
        "%s: is the sky of another model than %s, or of one that was changed since; it is not drawn: copy or export "
        "the model and its sky again",
        *(path, model.name),
    )
    return None


def _read(path: Path) -> tuple[Sky, dict[str, str]]:
    """The sky in a file, and the SHA-256 of the models that it belongs to, by name.  Raises DataError."""
    data = read_json(path, "the sky of a model")
    side, texels, models = (data.get(key) if isinstance(data, dict) else None for key in ("side", "texels", "models"))
    if isinstance(side, bool) or not isinstance(side, int) or not SIDES[0] <= side <= SIDES[1]:
        raise DataError(f"{path}: expected a side from {SIDES[0]} to {SIDES[1]} texels; export the model again")
    try:
        array = np.array(texels, np.float32)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0, np.float32)
    if array.shape != (side * side, 3) or not np.isfinite(array).all():
        raise DataError(f"{path}: expected {side * side} texels of three finite numbers; export the model again")
    known = models.items() if isinstance(models, dict) else ()
    return Sky(array), {name: one for name, one in known if isinstance(one, str)}
