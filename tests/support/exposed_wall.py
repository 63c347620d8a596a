"""A wall of squares, photographed with different exposures."""

from pathlib import Path

import numpy as np

from clsplat.photos.exposure_estimate import Exposures, measure_exposures
from clsplat.scene.camera import Camera
from clsplat.scene.colmap_writer import write_model
from clsplat.scene.images import write_image
from clsplat.scene.scene import PointCloud, Tracks
from clsplat.scene.view import View

SIZE, POINTS = 64, 400


class Wall:
    """Points on a wall, photographed from places beside each other, in squares of one color each."""

    def __init__(self, rng: np.random.Generator, photographs: int = 8, overlap: int = POINTS) -> None:
        side = 20
        self.colors = rng.uniform(0.1, 0.6, (POINTS, 3))
        at = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
        positions = np.column_stack([(3 * at + 2 - SIZE / 2) / SIZE, np.ones(POINTS)])
        camera = Camera(SIZE, SIZE, SIZE, SIZE, SIZE / 2, SIZE / 2)
        self.views = [View(f"{i}.png", camera, np.eye(3, 4)) for i in range(photographs)]
        starts = np.linspace(0, POINTS - overlap, photographs).astype(int)
        self.tracks = Tracks(
            positions, {v.name: np.arange(s, s + overlap) for v, s in zip(self.views, starts, strict=True)}
        )
        self.log_gains = rng.normal(0, 0.25, (photographs, 3))
        self.log_gains -= self.log_gains.mean(axis=0)
        self.at = 3 * at + 1

    def photograph(self, view: View) -> np.ndarray:
        """Squares of 3 x 3 px, 8 bits."""
        image = np.zeros((SIZE, SIZE, 3))
        for (x, y), color in zip(self.at, self.colors, strict=True):
            image[y : y + 3, x : x + 3] = color
        return np.rint(np.minimum(image * np.exp(self.log_gains[self.views.index(view)]), 1) * 255).astype(np.uint8)

    def write(self, folder: Path) -> None:
        """Write a COLMAP scene."""
        points = PointCloud(self.tracks.positions.astype(np.float32), self.colors.astype(np.float32))
        write_model(folder / "sparse" / "0", self.views, points, self.tracks)
        for view in self.views:
            write_image(folder / "images" / view.name, self.photograph(view))

    def measured(self) -> Exposures:
        return measure_exposures(self.tracks, self.views, lambda view: (self.photograph(view), None))
