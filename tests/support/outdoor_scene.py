"""A capture with known colors: a ground of squares under a painted sky, seen by a moving camera."""

from pathlib import Path

import numpy as np

from clsplat.scene.camera import Camera
from clsplat.scene.colmap_writer import write_model
from clsplat.scene.images import write_image
from clsplat.scene.scene import PointCloud, Tracks
from clsplat.scene.view import View

WIDTH, HEIGHT, FOCAL = 64, 48, 40.0


def painted(directions: np.ndarray) -> np.ndarray:
    """The colors of the sky in directions, [..., 3] with y down: blue, brighter to the horizon, with wide clouds."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    up = np.clip(-unit[..., 1:2], 0, 1)
    cloud = 0.15 * np.sin(3 * unit[..., 0:1] + 1) * np.cos(4 * unit[..., 2:])
    return np.clip(np.array([0.75, 0.8, 0.95]) - up * np.array([0.4, 0.25, 0.05]) + cloud, 0, 1)


class Yard:
    """Twelve photographs to all sides; y is down, the ground at y = 1."""

    def __init__(self, rng: np.random.Generator, photographs: int = 12, clear: bool = True) -> None:
        """clear: False puts a dark wall in the place of the sky."""
        self.squares, self.clear = rng.uniform(0.05, 0.5, (40, 40, 3)), clear
        camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
        self.views = [
            View(f"{i}.png", camera, self._pose(2 * np.pi * i / photographs, 0.3 * i)) for i in range(photographs)
        ]
        x, z = rng.uniform(-6, 6, (2, 600))
        positions = np.column_stack([x, np.ones(600), z])
        self.points = PointCloud(positions.astype(np.float32), self.ground(x, z).astype(np.float32))

    @staticmethod
    def _pose(angle: float, walked: float) -> np.ndarray:
        turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
        return np.column_stack([turn, -turn @ [walked - 1, 0, 0]]).astype(np.float32)

    def ground(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Colors of places on the ground."""
        return self.squares[np.clip(x + 20, 0, 39).astype(int), np.clip(z + 20, 0, 39).astype(int)]

    def rays(self, view: View) -> np.ndarray:
        """Directions through pixels, [HEIGHT, WIDTH, 3]."""
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
        return np.stack([x / FOCAL, y / FOCAL, np.ones_like(x)], axis=-1) @ view.world_to_camera[:, :3]

    def photograph(self, view: View) -> np.ndarray:
        """8 bits, [HEIGHT, WIDTH, 3]."""
        rays = self.rays(view)
        down = np.maximum(rays[..., 1], 1e-3)
        place = view.position + rays / down[..., None]
        above = painted(rays) if self.clear else np.full(rays.shape, 0.2)
        colors = np.where(rays[..., 1:2] > 0, self.ground(place[..., 0], place[..., 2]), above)
        return np.rint(255 * colors).astype(np.uint8)

    def write(self, folder: Path) -> Path:
        """Write a COLMAP scene; return its folder."""
        seen = {view.name: np.arange(len(self.points)) for view in self.views}
        write_model(folder / "sparse" / "0", self.views, self.points, Tracks(self.points.positions, seen))
        for view in self.views:
            write_image(folder / "images" / view.name, self.photograph(view))
        return folder


def missing(folder: Path, vector: np.ndarray, rng: np.random.Generator, exact: tuple[str, ...] = ()) -> Path:
    """Write a yard whose photographs show all points so far from where cameras do, but for some photographs."""
    yard = Yard(rng)
    seen = {view.name: visible_rows(view, yard.points.positions) for view in yard.views}
    missed = {name: np.tile(vector * (name not in exact), (len(rows), 1)) for name, rows in seen.items()}
    yard.write(folder)
    write_model(folder / "sparse" / "0", yard.views, yard.points, Tracks(yard.points.positions, seen, missed))
    return folder


def visible_rows(view: View, positions: np.ndarray) -> np.ndarray:
    """The rows of the points that lie in the image of a view."""
    x, y, z = view.world_to_camera[:, :3] @ positions.T.astype(float) + view.world_to_camera[:, 3:]
    return np.flatnonzero((z > 0.1) & (np.abs(x) < z) & (np.abs(y) < z))
