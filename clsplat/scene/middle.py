"""What the cameras of a scene look at: a point, a box around it, and random points in the box."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.scene.scene import PointCloud, Scene, View

RANDOM_BOX = 1.3 / 4.03  # half side of the box by camera distance: the value of 3DGS for the Blender scenes


def random_points(scene: Scene, count: int, seed: int) -> PointCloud:
    """Return grey points, uniform in a box around the point that the training cameras look at."""
    centre, half_side = looked_at_box(scene)
    rng = np.random.default_rng([seed, count])
    spread = rng.uniform(-half_side, half_side, (count, 3))
    return PointCloud((centre + spread).astype(np.float32), np.full((count, 3), 127 / 255, np.float32))


def looked_at_box(scene: Scene) -> tuple[NDArray[np.floating], float]:
    """Return the centre, [3], and half the side of a box around the point that the training cameras look at."""
    views = scene.split("train")
    positions, centre = np.stack([view.position for view in views]), centre_of(views)
    return centre, RANDOM_BOX * float(np.median(np.linalg.norm(positions - centre, axis=1)))


def centre_of(views: Sequence[View]) -> NDArray[np.floating]:
    """Return the point that the cameras look at, [3] scene units."""
    return looked_at(np.stack([v.position for v in views]), np.stack([v.world_to_camera[2, :3] for v in views]))


def looked_at(positions: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the point nearest to all optical axes, in least squares, [3] scene units."""
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    point, *_ = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, positions), rcond=None)
    return np.asarray(point)
