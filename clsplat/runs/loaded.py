"""What pictures are made of, on the host: Gaussians, or a field."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.model import Model, load
from clsplat.opencl.device import Device
from clsplat.render.painter import Painter, Splats
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.scene import Background, Scene
from clsplat.training.field_file import FieldModel, is_field, load_field
from clsplat.views.photographs import Photographs

Loaded = Model | FieldModel


def read(file: Path) -> Loaded:
    """Read a model file, or that of a field.  Raises DataError when it is missing, damaged or something else."""
    return load_field(file) if is_field(file) else load(file)


def painter_of(loaded: Loaded, device: Device, background: Background) -> Painter:
    """Return what renders it on a device; Gaussians before a background, a field before its own."""
    if isinstance(loaded, FieldModel):
        return loaded.upload(device)
    return Splats(Rasterizer(device), loaded.upload(device), Photographs(device, background).background)


def points_of(loaded: Loaded, scene: Scene | None) -> NDArray[np.float32]:
    """Return where something is, [M, 3]: means of Gaussians; for a field the scene's points, if it has any."""
    if isinstance(loaded, Model):
        return loaded.means
    points = scene.points if scene else None
    return np.zeros((0, 3), np.float32) if points is None else points.positions


def moves(loaded: Loaded) -> bool:
    """Whether it is of a scene that moves."""
    return isinstance(loaded, Model) and loaded.motion is not None


def size_of(loaded: Loaded) -> dict[str, int | None]:
    """Return what metrics.json says of its size."""
    if isinstance(loaded, Model):
        return {"gaussians": len(loaded)}
    return {"gaussians": None, "parameters": loaded.shape.learned}
