"""Represent a sky, a map from directions to colors behind the Gaussians, on the host, on a device, and in a file."""

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

# The octahedral map from directions to a square (Meyer et al. 2010), as in cl_kernels/sky.cl.

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def signs(directions: NDArray[np.floating]) -> Floats:
    """Return -1 for negative components and 1 for others, [..., 3]."""
    return np.where(directions < 0, -1.0, 1.0)


def texel_positions(directions: NDArray[np.floating], side: int) -> Floats:
    """Map directions, [..., 3], to texel coordinates, [..., 2], which start at -0.5; texel centers are integers."""
    directions = np.asarray(directions, np.float64)
    sign = signs(directions)
    negative_z = np.minimum(directions[..., 2:], 0)
    folded_xy = directions[..., :2] - sign[..., :2] * negative_z
    square = folded_xy / np.abs(directions).sum(axis=-1, keepdims=True)
    return np.asarray((square + 1) * (side / 2) - 0.5, np.float64)


def texel_directions(side: int) -> Floats:
    """Return the unit directions of all texel centers, [side * side, 3], row by row."""
    centers = (2 * np.arange(side) + 1) / side - 1
    v, u = (axis.ravel() for axis in np.meshgrid(centers, centers, indexing="ij"))
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    vectors = np.stack([u - np.where(u < 0, -fold, fold), v - np.where(v < 0, -fold, fold), z], axis=1)
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float64)


def texel_indices(i: Integers, j: Integers, side: int) -> Integers:
    """Return the indices of the texels in columns i and rows j, each from -1 to `side`.

    Beyond an edge, the map continues at the mirrored position of the same edge.
    """
    is_outside = (i < 0) | (i >= side)
    i, j = np.clip(i, 0, side - 1), np.where(is_outside, side - 1 - j, j)
    is_outside = (j < 0) | (j >= side)
    i, j = np.where(is_outside, side - 1 - i, i), np.clip(j, 0, side - 1)
    return j * side + i


def neighbor_texels(side: int) -> Integers:
    """Return the indices of the texels in each texel's 3x3 neighborhood, [side * side, 9]."""
    j, i = (axis.ravel() for axis in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    return np.stack([texel_indices(i + right, j + down, side) for down in (-1, 0, 1) for right in (-1, 0, 1)], axis=1)


def bilinear_texels(i: Integers, j: Integers, side: int) -> Integers:
    """Return the indices, [..., 4], of the four texels around coordinates with integer parts i, j in [-1, side - 1]."""
    return np.stack([texel_indices(i + right, j + down, side) for down in (0, 1) for right in (0, 1)], axis=-1)


def bilinear_weights(fractions: Floats) -> Floats:
    """Return the bilinear weights, [..., 4], of the four texels around coordinates with fractional parts [..., 2]."""
    x, y = fractions[..., 0], fractions[..., 1]
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=-1)


def sample_texels(texels: NDArray[np.floating], directions: NDArray[np.floating]) -> Floats:
    """Sample a map, [side * side, C], in directions, [..., 3], by bilinear interpolation; return [..., C]."""
    side = int(np.sqrt(len(texels)))
    position = texel_positions(directions, side)
    corner = np.floor(position).astype(np.int64)
    values = texels[bilinear_texels(corner[..., 0], corner[..., 1], side)]
    return np.asarray(np.einsum("...kc,...k->...c", values, bilinear_weights(position - corner)))


LOG = logging.getLogger("clsplat")

SIDES = 8, 512  # texels: smallest and largest
MEANING = (
    "colors behind the model by direction, as an octahedral map: with s = |x| + |y| + |z|, the direction (x, y, z) of "
    "the scene maps to (u, v) = (x, y) / s, or if z < 0 to (x - sign(x) z, y - sign(y) z) / s; texels are red, green, "
    "and blue, stored row by row, with centers at u, v = -1 + (2 i + 1) / side"
)


@dataclass(frozen=True)
class DeviceSky:
    """A sky on the device."""

    texels: Array  # [3, side * side]
    side: int

    def to_host(self) -> "Sky":
        """Copy the map to the host."""
        return Sky(np.ascontiguousarray(self.texels.get().T))


@dataclass(frozen=True, eq=False)
class Sky:
    """The colors behind a model for all directions, as an octahedral map."""

    texels: NDArray[np.float32]  # [side * side, 3], row by row

    @property
    def side(self) -> int:
        """The number of texels in a row."""
        return int(np.sqrt(len(self.texels)))

    def upload(self, device: Device) -> DeviceSky:
        """Copy the sky to a device."""
        return DeviceSky(device.upload(np.ascontiguousarray(self.texels.T)), self.side)

    def rotated(self, rotation: NDArray[np.floating]) -> "Sky":
        """Return the sky rotated by a matrix, [3, 3], and resampled by bilinear interpolation."""
        return Sky(sample_texels(self.texels, texel_directions(self.side) @ rotation).astype(np.float32))

    def write(self, path: Path, models: Mapping[str, str]) -> None:
        """Write the sky as JSON, with exact values and the SHA-256 of each of its model files.

        models: SHA-256 by file name.  Raises OutputError.
        """
        rows = [[float(value) for value in texel] for texel in self.texels]
        hashes = dict(sorted(models.items()))
        data = {"meaning": MEANING, "type": "directions", "models": hashes, "side": self.side, "texels": rows}
        write_text(path, json.dumps(data) + "\n")


WITHOUT_SKY = "_without_sky"  # in the name of a model file next to one with Gaussians of the sky


def sky_path(model: Path) -> Path:
    """Return the path of a model's sky file, which the `_raw` and `_without_sky` variants of the model share."""
    return model.with_name(f"{model.stem.removesuffix('_raw').removesuffix(WITHOUT_SKY)}_sky.json")


def without_sky_path(model: Path) -> Path:
    """Return the path for the model without sky Gaussians, next to the model file that has them."""
    return model.with_name(f"{model.stem}{WITHOUT_SKY}{model.suffix}")


def write_sky_file(sky: Sky | None, model: Path, digest: str) -> None:
    """Write a sky next to its model file; if `sky` is None, remove the model from the sky file.

    digest: SHA-256 of the model file.  If the sky in the file is identical, its entries for other models are kept.
    Raises OutputError.
    """
    path = sky_path(model)
    try:
        old_sky, models = _read(path) if path.is_file() else (None, {})
    except DataError:  # a damaged sky belongs to no model
        old_sky, models = None, {}
    other_models = {name: value for name, value in models.items() if name != model.name and (sky or value != digest)}
    if sky:
        is_unchanged = old_sky is not None and np.array_equal(old_sky.texels, sky.texels)
        sky.write(path, {**(other_models if is_unchanged else {}), model.name: digest})
    elif old_sky and other_models:
        old_sky.write(path, other_models)
    elif old_sky and models:
        try:
            path.unlink()
        except OSError as error:
            raise write_error(path, error) from error


def read_sky_file(model: Path, is_expected: bool = False) -> Sky | None:
    """Return the sky of a model file, or None.  Warn if an expected sky is missing, or if the sky is of another model.

    Raises DataError if its file is damaged.
    """
    path = sky_path(model)
    if not path.is_file():
        if is_expected:
            LOG.warning("%s: was trained with a sky; put %s next to it to render the sky", model, path.name)
        return None
    sky, models = _read(path)
    if sha256(model) in models.values():
        return sky
    if without_sky_path(model).name in models:  # Gaussians of `model` show the sky
        return None
    LOG.warning(
        "%s: the sky does not belong to %s, or the model has changed, so the sky is not rendered; copy or export the "
        "model and its sky again",
        *(path, model.name),
    )
    return None


def _read(path: Path) -> tuple[Sky, dict[str, str]]:
    """Read a sky and the SHA-256 of its models by name.  Raises DataError."""
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
    items = models.items() if isinstance(models, dict) else ()
    return Sky(array), {name: digest for name, digest in items if isinstance(digest, str)}
