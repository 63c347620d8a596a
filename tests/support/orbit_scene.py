"""A COLMAP scene with cameras on a circle, and the findings of its inspection."""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.prepare.inspect.findings import Inspection
from tests.support.colmap_writer import CameraEntry, ColmapModel, ImageEntry, PointEntry, write_scene

COUNT = 24  # cameras on a circle of radius 4 that look at points in a ball of radius 1


SIZE = (64, 48)


def orbit() -> ColmapModel:
    images = []
    for i, angle in enumerate(np.linspace(0, 2 * np.pi, COUNT, endpoint=False)):
        backwards = np.array([np.cos(angle), np.sin(angle), 0.0])
        rotation = np.stack([np.cross(backwards, (0, 0, 1)), (0, 0, -1), -backwards])  # right, down, forward
        rotation[0] = np.cross(rotation[1], rotation[2])
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        images.append(ImageEntry(f"{i:02}.png", 1, (w, x, y, z), (0.0, 0.0, 4.0)))
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (200, 3))
    camera = CameraEntry(1, "PINHOLE", *SIZE, (60.0, 60.0, 32.0, 24.0))
    return ColmapModel([camera], images, [PointEntry(place) for place in places.tolist()])


def write(path: Path, model: ColmapModel, kind: str = "bin", size: tuple[int, int] = SIZE) -> Path:
    """Write a scene with a real photograph for each image."""
    write_scene(path, model, kind)
    for image in model.images:
        photograph(path / "images" / image.name, size)
    return path


def photograph(file: Path, size: tuple[int, int] = SIZE) -> None:
    noise = np.random.default_rng(list((file.parent.name + file.name).encode())).integers(
        0, 255, (size[1], size[0], 3), np.uint8
    )
    _, data = cv2.imencode(file.suffix, noise)
    file.write_bytes(data.tobytes())


def finding_text(inspection: Inspection, level: str) -> str:
    """The text of the only finding of a level."""
    (text,) = [finding.text for finding in inspection.findings if finding.level == level]
    return text
