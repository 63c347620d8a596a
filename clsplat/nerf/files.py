"""Read and write the file of a field: an .npz with checksums (clsplat.training.archive) and without pickle.

parameters.npy    [P, 1] float32, the parameters in the layout of clsplat.nerf.shape
meta.npy          JSON: `format`, the `version` that wrote it, `shape` with the keys of `train_field.field`, the
                  `background`, the `alpha` of the photos, and the `origin` if it is not 0
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from clsplat.core.errors import DataError, one_line, quote, shorten
from clsplat.core.files import open_atomic, path_exists
from clsplat.core.reading import sha256
from clsplat.core.resources import __version__
from clsplat.gaussians.model import Rendering, run_output
from clsplat.nerf.field import Field
from clsplat.nerf.shape import FieldShape, WrittenShape
from clsplat.opencl.device import Device
from clsplat.photos.photographs import BACKGROUNDS
from clsplat.scene.scene import Scene
from clsplat.training import archive

FORMAT: Final = 1
SUFFIX, FILE, PARAMETERS = ".npz", "field.npz", "parameters"


class Metadata(BaseModel):
    """The metadata in the file of a field."""

    model_config = ConfigDict(strict=True, extra="forbid")

    format: Literal[1]
    version: str
    shape: WrittenShape
    background: Literal["black", "white"]
    alpha: Literal["transparency", "mask"]
    origin: list[float] | None = None


@dataclass(frozen=True, eq=False)
class FieldModel:
    """A field on the host, as `train_field` trains it.

    Raises ValueError if the parameters do not fit the shape, the unit is not a number, or the origin is not 3 numbers.
    """

    shape: FieldShape
    parameters: NDArray[np.float32]  # [P]
    rendering: Rendering  # background, and the meaning of the photos' fourth channel
    origin: NDArray[np.floating] = field(default_factory=lambda: np.zeros(3))  # [3] world coordinates of its origin

    def __post_init__(self) -> None:
        if self.parameters.shape != (self.shape.table_length,):
            raise ValueError(
                f"its parameters have shape {self.parameters.shape}; expected ({self.shape.table_length},)"
            )
        _ = self.shape.scene_units
        if self.origin.shape != (3,):
            raise ValueError(f"its origin has {len(self.origin)} numbers; expected 3")

    def in_scene(self, scene: Scene) -> "FieldModel":
        """Return the field for a scene.  Raises DataError if the scene has another origin."""
        return self.with_origin(scene.origin)

    def with_origin(self, origin: NDArray[np.floating]) -> "FieldModel":
        """Return the field if it has this origin.  Raises DataError otherwise, since a field cannot be moved."""
        if np.array_equal(self.origin, origin):
            return self
        raise DataError(
            f"the field has the origin {self.origin}, but the scene has {origin}; use the scene it was trained on"
        )

    def upload(self, device: Device) -> Field:
        """Copy the field and its background to a device."""
        background = device.upload(np.array(BACKGROUNDS[self.rendering.background or "black"], np.float32))
        return Field(self.shape, device.upload(self.parameters), background)

    def save(self, path: str | Path) -> str:
        """Write the field to a file, and return its SHA-256.  Raises OutputError if the file cannot be written."""
        path, rendering = Path(path), self.rendering
        metadata = Metadata(
            format=FORMAT,
            version=__version__,
            shape=self.shape,
            background=rendering.background or "black",
            alpha=rendering.alpha,
        )
        origin = {"origin": self.origin.tolist()} if self.origin.any() else {}
        with open_atomic(path) as file:
            archive.write(
                file, {**metadata.model_dump(exclude={"origin"}), **origin}, [(PARAMETERS, self.parameters[:, None])]
            )
        return sha256(path)

    def __repr__(self) -> str:
        return f"FieldModel({self.shape.parameter_count:,} parameters)"


def is_field(path: Path) -> bool:
    """Return whether a path has the extension of a field's file."""
    return path.suffix.lower() == SUFFIX


def find_field(folder: Path) -> Path:
    """Return the path of the last file that `export_field` wrote in a run folder."""
    return run_output(folder, "export_field", FILE)


def load_field(path: str | Path) -> FieldModel:
    """Read a field from its file or from a run folder.

    Raises DataError if the file is missing or damaged, or contains something else.
    """
    path = find_field(Path(path)) if Path(path).is_dir() else Path(path)
    if not path_exists(path):
        raise DataError(f"{path}: not found; expected a file of the stage export_field")
    try:
        return _parse_field(*archive.read(path))
    except (DataError, ValueError) as error:
        reason = shorten(one_line(error))
        raise DataError(f"{path}: {reason}; expected an intact file of the stage export_field") from error


def _parse_field(notes: Mapping[str, Any], arrays: archive.Arrays) -> FieldModel:
    """Return the field that a file contains.  Raises DataError or ValueError."""
    if notes.get("format") != FORMAT or "shape" not in notes:
        raise DataError(f"it is not a field, or has an unknown format, {quote(str(notes.get('format')))}")
    try:
        meta = Metadata.model_validate(dict(notes))
    except ValidationError as error:
        first = error.errors()[0]
        raise DataError(f"metadata {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    if arrays.keys() != {PARAMETERS}:
        raise DataError(f"expected only the array '{PARAMETERS}'")
    table = arrays[PARAMETERS]
    if table.dtype != np.float32 or table.shape != (meta.shape.table_length, 1):
        raise DataError(f"{PARAMETERS} are not [{meta.shape.table_length}, 1] float32")
    if not np.isfinite(table).all():
        raise DataError(f"{PARAMETERS} contain values that are not finite")
    rendering, origin = Rendering(background=meta.background, alpha=meta.alpha), np.array(meta.origin or np.zeros(3))
    return FieldModel(meta.shape, np.array(table[:, 0]), rendering, origin)
