"""Where the cube of a field's grid lies beside what photographs show: outside of that nothing is learned."""

import itertools

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import ConfigError
from clsplat.fields.grid import GridShape
from clsplat.fields.shape import FieldShape
from clsplat.scene.middle import centre_of
from clsplat.scene.scene import Scene
from clsplat.scene.view import View

Floats = NDArray[np.float64]
UNIT = np.array(list(itertools.product((0.0, 1.0), repeat=3)))  # the corners of a cube, [8, 3]


def require_seen(shape: FieldShape, scene: Scene) -> None:
    """Raise ConfigError for a cube that no training view sees between near and far, or that holds no point of a scene
    with points."""
    cube, views, points = shape.grid, scene.split("train"), scene.points
    if cube is None or not views:
        return
    corner, side = np.array(cube.corner), cube.side
    if not any(_meet(corner + side * UNIT, _corners(view, shape.near, shape.far)) for view in views):
        fault = f"no training view sees it at depths from {shape.near:g} to {shape.far:g}"
    elif points and len(points) and not _inside(cube, np.asarray(points.positions, np.float64)).any():
        fault = f"none of the scene's {len(points):,} points lies in it"
    else:
        return
    least, most, seen = (_told(point) for point in (corner, corner + side, centre_of(views)))
    raise ConfigError(
        f"train_field.field.grid: its cube is from {least} to {most}, scene units, and {fault} ({scene.path}); "
        f"expected one about what the cameras look at, near {seen}: set `corner` and `side`, and `near` and `far` "
        "beside `grid`"
    )


def _inside(cube: GridShape, positions: Floats) -> NDArray[np.bool_]:
    """Which points, [M, 3], lie in a cube."""
    return np.asarray((np.abs(positions - (np.array(cube.corner) + cube.side / 2)) <= cube.side / 2).all(axis=1))


def _corners(view: View, near: float, far: float) -> Floats:
    """The corners of what a view sees between two depths, [8, 3]: UNIT over the columns, the rows and the depth."""
    camera = view.camera
    across = (UNIT[:, :2] * [camera.width, camera.height] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    places = np.column_stack([across, np.ones(8)]) * (near + UNIT[:, 2:] * (far - near))
    rotation, translation = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
    return np.asarray((places - translation) @ rotation)


def _meet(cube: Floats, frustum: Floats) -> bool:
    """Whether two bodies, by their corners as UNIT has them, have a point in common: no axis parts them (Gottschalk,
    Lin and Manocha 1996)."""
    axes, edges = np.eye(3), frustum[[1, 5, 3, 7, 4, 2]] - frustum[[0, 4, 2, 6, 0, 0]]  # along the depth, row, column
    faces = np.cross(edges[[4, 4, 4, 5, 5]], edges[[5, 0, 2, 0, 1]])
    candidates = np.vstack([axes, faces, np.cross(axes[:, None], edges[None]).reshape(-1, 3)])
    of_cube, of_frustum = cube @ candidates.T, frustum @ candidates.T
    apart = (of_cube.max(axis=0) < of_frustum.min(axis=0)) | (of_frustum.max(axis=0) < of_cube.min(axis=0))
    return not bool(apart.any())


def _told(point: NDArray[np.floating]) -> str:
    return f"({', '.join(f'{round(float(value), 6) + 0.0:.4g}' for value in point)})"
