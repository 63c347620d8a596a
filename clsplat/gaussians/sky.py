"""The colours behind the Gaussians by direction: a map on the host, on the device, and in a file beside a model's."""

import json
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.files import write_text
from clsplat.gaussians.octahedral import sampled, texel_directions
from clsplat.opencl.device import Array, Device
from clsplat.reading import read_json

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

    def write(self, path: Path) -> None:
        """Write it as JSON; numbers keep their bits.  Raises OutputError."""
        rows = [[float(value) for value in texel] for texel in self.texels]
        data = {"meaning": MEANING, "type": "directions", "side": self.side, "texels": rows}
        write_text(path, json.dumps(data) + "\n")


def sky_file(model: Path) -> Path:
    """Return the file that holds the sky of a model file, where it has one; of one as it was trained, `_raw`, too."""
    return model.with_name(f"{model.stem.removesuffix('_raw')}_sky.json")


def sky_beside(model: Path, expected: bool = False) -> Sky | None:
    """Return the sky of a model file; None without one, with a warning where one is expected.

    Raises DataError where its file is damaged.
    """
    path = sky_file(model)
    if not path.is_file():
        if expected:
            LOG.warning("%s: was trained with a sky, which is drawn where %s lies beside it", model, path.name)
        return None
    data = read_json(path, "the sky of a model")
    side, texels = (data.get(key) if isinstance(data, dict) else None for key in ("side", "texels"))
    if isinstance(side, bool) or not isinstance(side, int) or not SIDES[0] <= side <= SIDES[1]:
        raise DataError(f"{path}: expected a side from {SIDES[0]} to {SIDES[1]} texels; export the model again")
    try:
        array = np.array(texels, np.float32)
    except (TypeError, ValueError, OverflowError):
        array = np.zeros(0, np.float32)
    if array.shape != (side * side, 3) or not np.isfinite(array).all():
        raise DataError(f"{path}: expected {side * side} texels of three finite numbers; export the model again")
    return Sky(array)
