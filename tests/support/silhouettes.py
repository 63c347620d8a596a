"""A ball seen from all sides, cut out by its silhouette."""

import numpy as np

from clsplat.scene.camera import Camera
from clsplat.scene.view import View

SIZE, RADIUS = 120, 0.5


def ring(count: int = 40) -> list[View]:
    """Views from all sides, 4 units away from the origin, in a spiral from the top to the bottom."""
    camera = Camera(SIZE, SIZE, 150, 150, SIZE / 2, SIZE / 2)
    views = []
    for i in range(count):
        height = 1 - 2 * (i + 0.5) / count
        around = np.pi * (3 - 5**0.5) * i
        out = np.sqrt(1 - height**2)
        position = 4 * np.array([out * np.cos(around), out * np.sin(around), height])
        views.append(View.looking_at(position, np.zeros(3), [0, 0, 1], camera, name=str(i)))
    return views


def ball(view: View, center=(0.0, 0.0, 0.0), radius=RADIUS) -> np.ndarray:
    """A ball whose color is its direction, drawn by rays: [H, W, 4]."""
    columns, rows = np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5)
    rays = np.stack([(columns - SIZE / 2) / 150, (rows - SIZE / 2) / 150, np.ones_like(rows)], -1)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ view.world_to_camera[:, :3]
    to = np.asarray(center) - view.position
    along = rays @ to
    inside = radius**2 - (to @ to - along**2)
    hit = inside > 0
    normal = (view.position + rays * (along - np.sqrt(np.maximum(inside, 0)))[..., None] - center) / radius
    return np.where(hit[..., None], np.dstack([(normal + 1) * 127, 255 * hit]), 0).astype(np.uint8)
