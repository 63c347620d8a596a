"""The places and focal lengths of the cameras in a run: where a training begins and ends, and where it is measured."""

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import ConfigError, DataError, PoseError, amount, quoted
from clsplat.files import write_text
from clsplat.names import VIEW_POSES
from clsplat.reading import read_json
from clsplat.scene.reprojection import with_cameras
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.zoom import zooms
from clsplat.training.run import Run
from clsplat.views.focal_lengths import FocalLengths
from clsplat.views.photograph_poses import PhotographPoses
from clsplat.views.poses import Floats, Poses

FEWEST, POINTS = 10, 10_000  # of the points that tell a depth
MOST_ZOOM = 10.0  # times a focal length, or a tenth: far beyond what is learned of one
LOG = logging.getLogger("clsplat")


def photograph_poses(poses: Poses | None, run: Run, last: int) -> PhotographPoses | None:
    """Return the poses of a training whose last global step is given, or None where they are the dataset's:
    those that a training before has learned stay.

    The numbers of a run that begins are set; a resumed run has them.  Raises ConfigError where the model has a sky,
    DataError where a lens has no form with another focal length.
    """
    views, focals = run.scene.split("train"), FocalLengths.of(run.original.views)
    if poses is None:
        learned = PhotographPoses(views, focals=focals)  # by a training before, whose model this one goes on with
        return learned if learned.begun(run.numbers) else None
    if run.sky:
        raise poses_beside_a_sky()
    rates = poses.rates(last, len({view.name for view in views}))
    cameras = len({focals.cameras[view.name] for view in views})
    found = PhotographPoses(views, poses.start, *rates, replace(focals, rate=poses.focal_rate(last, cameras)))
    if found.focals.rate:
        require_zoom(run.original)
    if not found.begun(run.numbers):
        found.begin(run.numbers, {view.name: depth_of(view, run.scene) for view in views})
    return found


def poses_beside_a_sky() -> ConfigError:
    """The error of poses that are to be learned with a model that has a sky."""
    return ConfigError(
        "optimize.poses: the model has a sky, which is not learned together with poses; set optimize.poses to null, "
        "or leave model.background out"
    )


def require_zoom(scene: Scene) -> None:
    """Raise DataError where a view has a lens that cannot be written with another focal length."""
    for view in scene.views:
        if view.lens is not None and not zooms(view.lens):
            raise DataError(
                f"{scene.path}: optimize.poses.focal: the lens of {quoted(view.name)}, {view.lens.model}, cannot be "
                "written with another focal length; `clsplat data undistort` first, or leave out poses.focal"
            )


def depth_of(view: View, scene: Scene) -> float:
    """Return the median depth of the scene's points that a view may show; the extent where they are too few."""
    points = np.zeros((0, 3)) if scene.points is None else scene.points.positions
    points = np.asarray(points[:: 1 + len(points) // POINTS], np.float64)
    x, y, z = np.einsum("ij,nj->in", view.world_to_camera[:, :3], points) + view.world_to_camera[:, 3:]
    z = np.where(z > 0, z, np.inf)
    column, row = (view.camera.fx * x / z + view.camera.cx, view.camera.fy * y / z + view.camera.cy)
    inside = np.isfinite(z) & (column >= 0) & (column < view.camera.width) & (row >= 0) & (row < view.camera.height)
    return float(np.median(z[inside])) if np.count_nonzero(inside) >= FEWEST else float(scene.extent)


def refined(numbers: Mapping[str, float], scene: Scene) -> Scene:
    """Return the scene of a run, at its full size, with what it has learned of cameras; the same one where it has
    learned nothing.  Views that were not trained on have the focal lengths of their camera.

    The other cameras are moved as those of the training views are as a whole: about their mean, by the scale between
    the centres before and after.  Their rotations stay, as the mean of the learned ones does.
    """
    training, focals = PhotographPoses(scene.split("train")), FocalLengths.of(scene.views)
    if not training.views or not training.begun(numbers):
        return scene
    learned = {view.name: training.pose(numbers, number) for number, view in enumerate(training.views)}
    before = np.array([view.position for view in training.views])
    after = np.array([_centre(learned[view.name]) for view in training.views])
    middle, moved_middle = before.mean(axis=0), after.mean(axis=0)
    around = before - middle
    spread = float((around**2).sum())
    scale = float((around * (after - moved_middle)).sum()) / spread if spread > 0 else 1.0

    def pose(view: View) -> Floats:
        if view.name in learned:
            return learned[view.name]
        rotation = view.world_to_camera[:, :3]
        return np.column_stack([rotation, -rotation @ (moved_middle + scale * (view.position - middle))])

    def found(view: View) -> View:
        camera = view.camera.zoomed(focals.factor(numbers, view.name))
        return replace(view, world_to_camera=pose(view), camera=camera)

    return with_cameras(scene, list(map(found, scene.views)))


def _centre(pose: Floats) -> Floats:
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def write_view_poses(run: Run, poses: PhotographPoses | None) -> None:
    """Write the poses that each photograph has for the model into the run folder; log how far they have moved."""
    if poses is None:
        return
    views, names = refined(run.numbers, run.original).views, {view.name for view in poses.views}
    cameras = poses.focals.learned(run.numbers)
    data = {
        "meaning": "poses in which the model shows each photograph, rows of [R | t] from the world to the camera; "
        "learned: those of training photographs; others have moved with them as a whole"
        + ("; focal_lengths: in x and y, px, at the full size of the undistorted photographs" if cameras else ""),
        "photographs": {
            view.name: {
                "learned": view.name in names,
                "world_to_camera": view.world_to_camera.tolist(),
                **({"focal_lengths": [view.camera.fx, view.camera.fy]} if cameras else {}),
            }
            for view in views
        },
    }
    write_text(run.out / VIEW_POSES, json.dumps(data, indent=1) + "\n")
    moves = [poses.move(run.numbers, view) for view in poses.tables[0].views]
    turns, shifts = [math.hypot(*move.turn) for move in moves], [math.hypot(*move.shift) / move.depth for move in moves]
    LOG.info(
        "poses of %d photographs in %s: turned by up to %.3f°, shifted by up to %.2g of the depth; medians %.3f°, %.2g",
        *(len(names), VIEW_POSES, math.degrees(max(turns)), max(shifts)),
        *(math.degrees(float(np.median(turns))), float(np.median(shifts))),
    )
    if cameras:
        factors = [poses.focals.factor(run.numbers, camera) for camera in cameras]
        LOG.info("focal lengths of %s: times %s", amount(len(cameras), "camera"), _range(min(factors), max(factors)))


def _range(low: float, high: float) -> str:
    return f"{low:.4f}" if low == high else f"{low:.4f} to {high:.4f}"


def poses_beside(model: Path, scene: Scene) -> Scene:
    """Return a scene, at its full size, with the poses and focal lengths that lie beside a model file; the same one
    without such a table.

    Raises DataError where the table is damaged.
    """
    path = model.with_name(VIEW_POSES)
    if not path.is_file():
        return scene
    data = read_json(path, "poses of photographs")
    found = data.get("photographs") if isinstance(data, dict) else None
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a mapping 'photographs'; train again, or remove the file")
    return with_cameras(scene, [_with_pose(path, view, found.get(view.name)) for view in scene.views])


def _with_pose(path: Path, view: View, row: Any) -> View:
    """The view with the pose of its row; as it is where it has none."""
    if row is None:
        return view
    try:
        fx, fy = map(float, row.get("focal_lengths", (view.camera.fx, view.camera.fy)))
        if not all(1 / MOST_ZOOM <= zoom <= MOST_ZOOM for zoom in (fx / view.camera.fx, fy / view.camera.fy)):
            raise ValueError("no focal lengths of this camera")
        camera = replace(view.camera, fx=fx, fy=fy).check()
        return replace(view, world_to_camera=np.array(row["world_to_camera"], np.float64), camera=camera)
    except (AttributeError, KeyError, TypeError, ValueError, PoseError) as error:
        raise DataError(
            f"{path}: {quoted(view.name)} has no pose of 3 rows of 4 numbers with a rotation, or no two focal lengths "
            f"within {MOST_ZOOM:g} times those of its camera; train again, or remove the file"
        ) from error
