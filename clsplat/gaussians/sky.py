"""The colours behind the Gaussians by direction: a map on the host, on the device, and in a file beside a model's."""

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.files import unwritable, write_text
from clsplat.gaussians.octahedral import sampled, texel_directions
from clsplat.opencl.device import Array, Device
from clsplat.reading import read_json, sha256

LOG = logging.getLogger("clsplat")
Floats = NDArray[np.float32]
SIDES = 8, 512  # texels: smallest and largest
MEANING = (
    "colours behind the model by direction, an octahedral map: with s = |x| + |y| + |z| the direction (x, y, z) of the "
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
    """A map of the colours behind a model."""

    texels: Floats  # [side * side, 3], row by row

    @property
    def side(self) -> int:
        """Texels in a row."""
        return int(np.sqrt(len(self.texels)))

    def upload(self, device: Device) -> DeviceSky:
        """Copy it to a device."""
        return DeviceSky(device.upload(np.ascontiguousarray(self.texels.T)), self.side)

    def turned(self, rotation: NDArray[np.floating]) -> "Sky":
        """Return the map of a scene that is turned by x -> rotation x, [3, 3]; colours between texels are bilinear."""
        return Sky(sampled(self.texels, texel_directions(self.side) @ rotation).astype(np.float32))

    def write(self, path: Path, models: Mapping[str, str]) -> None:
        """Write it as JSON, with the SHA-256 of the model files that it belongs to, by name; numbers keep their bits.

        Raises OutputError.
        """
        rows = [[float(value) for value in texel] for texel in self.texels]
        own = dict(sorted(models.items()))
        data = {"meaning": MEANING, "type": "directions", "models": own, "side": self.side, "texels": rows}
        write_text(path, json.dumps(data) + "\n")


def sky_file(model: Path) -> Path:
    """Return the file that holds the sky of a model file, where it has one; of one as it was trained, `_raw`, too."""
    return model.with_name(f"{model.stem.removesuffix('_raw')}_sky.json")


def keep_sky(sky: Sky | None, model: Path, digest: str) -> None:
    """Write the sky of a model file, of that SHA-256, beside it; without a sky, let none that is there belong to it.

    Other model files of the same stem stay with a sky that is the same.  Raises OutputError.
    """
    path = sky_file(model)
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
            raise unwritable(path, error) from error


def sky_beside(model: Path, expected: bool = False) -> Sky | None:
    """Return the sky of a model file; None without one, with a warning where one is expected or is of another model.

    Raises DataError where its file is damaged.
    """
    path = sky_file(model)
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
