"""The places and focal lengths of the cameras, learned with the model, where poses are not exact."""

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import DataError, PoseError, pluralize, quote
from clsplat.core.files import write_text
from clsplat.core.reading import read_json
from clsplat.core.schedule import Decay, NonNegative, Schedule, at_step, explain_schedule
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.opencl.device import Array, constants
from clsplat.photos.appearance import ViewTable, adam_step
from clsplat.render.camera import moved_camera
from clsplat.render.rasterizer import Frame, shape_arguments
from clsplat.render.workspace import Workspace
from clsplat.scene.reprojection import with_cameras
from clsplat.scene.scene import Scene
from clsplat.scene.view import View, zooms
from clsplat.training.modules.base import ModuleState, Scalars, TrainingModule, TrainingStep
from clsplat.training.run import Run

Floats = NDArray[np.float64]
VIEW_POSES = "view_poses.json"
TURNS, SHIFTS, DEPTHS, FOCALS, AXES = "turns", "shifts", "depths", "focal_lengths", ("x", "y", "z")
SUMS, GROUP = (int(constants("poses.cl")[name]) for name in ("POSE_SUMS", "POSE_GROUP"))
RATE, MOST = 2e-4, 2e-3  # learning rates at the start
FALL = 100  # from the first rate to the last
TURN_SHARE = 0.3  # ours: what a turn about that point does in the image is little, and so mostly noise
REACH = 0.01  # shares of the depth: what a photograph's visits must be enough for
FOCAL_RATE, FOCAL_MOST = 1e-4, 1e-3  # the same of the logarithms of focal lengths
FOCAL_REACH = 0.2  # of them: noise takes most of the way to a change of a few hundredths
FEWEST, POINTS = 10, 10_000  # of the points that tell a depth
MOST_ZOOM = 10.0  # times a focal length, or a tenth: far beyond what is learned of one
LOG = logging.getLogger("clsplat")


class CameraOptimizer(TrainingModule):
    """Turn and shift the camera of each photograph a little, learned with the model, where poses are not exact.

    A photograph has a rotation vector and a shift in the axes of the world, by Adam, all 0 at first.  The camera turns
    about the point of its axis at the median depth of the dataset's points; without points, at the extent.  A step
    changes those of its photograph; then their means over the photographs are subtracted: what moves all cameras alike
    would be the same to every loss if the Gaussians moved too.  The world filter, rules that compare the model with
    photographs, and the extent are those of the dataset's cameras.

    With `focal`, photographs that share a camera in the dataset share a factor of both of its focal lengths.  It has no
    mean to subtract: a single camera may change.  What stays with poses stays with it too, and so does the principal
    point.  Where cameras walk ahead, a focal length is little else than depth: leave it then.

    It is for poses of a phone's tracking, or where structure from motion left errors of more than a pixel.  Poses of
    structure from motion are mostly better than what training makes of them.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"turn", "shift", "focal", "start"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    conflicts: ClassVar[Mapping[str, str]] = {
        "sky": "the model has a sky, which is not learned together with poses",
        "inverse_depth": "the loss would not move them",
        "blocks": "those of blocks would differ",
    }
    side_files: ClassVar[Mapping[str, str]] = {VIEW_POSES: "poses"}

    type: Literal["camera_optimizer"] = "camera_optimizer"
    turn: Annotated[Literal["auto"] | NonNegative, explain_schedule(", or auto")] = "auto"
    """Learning rate of the rotations in rad, by step; auto: 0.3 times the automatic one of the shifts."""
    shift: Annotated[Literal["auto"] | NonNegative, explain_schedule(", or auto")] = "auto"
    """Learning rate of the shifts as a share of that depth, by step; auto: 2e-4 to 2e-6, where photographs are seldom
    visited as large as a shift of 0.01 needs, up to 2e-3."""
    focal: Annotated[Literal["auto"] | NonNegative, explain_schedule(", or auto")] = 0.0
    """Learning rate of the logarithms of focal lengths, by step; 0: they stay.  auto: 1e-4 to 1e-6, where cameras are
    seldom visited so large that the rates of a camera's visits add up to 0.2, up to 1e-3."""
    start: Annotated[int, Field(ge=0)] = 500
    """Global step after which poses are learned: before it the model is a blur, which tells nothing of them."""

    def rates(self, last: int, photographs: int) -> tuple[Schedule, Schedule]:
        """Return the learning rates by step of rotations and shifts, of a training up to a step of so many
        photographs."""
        shift = self._falling(last, photographs, REACH, (RATE, MOST))
        turn = shift.divide(1 / TURN_SHARE)
        return (turn if self.turn == "auto" else self.turn), (shift if self.shift == "auto" else self.shift)

    def focal_rate(self, last: int, cameras: int) -> Schedule:
        """Return the learning rate by step of focal lengths, of a training up to a step of so many cameras."""
        return (
            self._falling(last, cameras, FOCAL_REACH, (FOCAL_RATE, FOCAL_MOST)) if self.focal == "auto" else self.focal
        )

    def _falling(self, last: int, rows: int, reach: float, bounds: tuple[float, float]) -> Decay:
        """A rate that falls, and whose sum over the visits of one of so many rows is `reach`, within bounds."""
        steps = max(last - self.start, 1)
        visits = steps / rows
        needed = reach * math.log(FALL) * FALL / (FALL - 1) / visits
        initial = min(max(bounds[0], needed), bounds[1])
        return Decay(initial=initial, final=initial / FALL, over=steps, start=self.start)

    def check_run(self, run: Run) -> None:
        if self.focal:
            require_zoom(run.original)

    def create_state(self, run: Run) -> "CameraState":
        return CameraState(self, run.scene.split("train"), run.original.views)

    @classmethod
    def apply_side_files(cls, model: Path, scene: Scene) -> Scene:
        """Return a scene, at its full size, with the poses and focal lengths in the table next to a model file."""
        path = model.with_name(VIEW_POSES)
        if not path.is_file():
            return scene
        data = read_json(path, "poses of photographs")
        found = data.get("photographs") if isinstance(data, dict) else None
        if not isinstance(found, dict):
            raise DataError(f"{path}: expected a mapping 'photographs'; train again, or remove the file")
        return with_cameras(scene, [_with_pose(path, view, found.get(view.name)) for view in scene.views])


@dataclass(frozen=True)
class Move:
    """A rotation vector and a shift, each [3], of a camera in the axes of the world.

    The camera turns about the point of its axis at a depth, where photographs show the scene: about its own center a
    turn is in the image nearly what a shift is, and Adam, number by number, does not tell them apart.
    """

    turn: Floats  # rad
    shift: Floats  # scene units
    depth: float  # scene units

    def of(self, world_to_camera: Floats) -> Floats:
        """Return a pose, [3, 4], after it: W' = W exp([turn]x), and (0, 0, depth) shows the same point, shifted."""
        rotation, translation = world_to_camera[:, :3], world_to_camera[:, 3]
        turned = rotation @ scipy.spatial.transform.Rotation.from_rotvec(self.turn).as_matrix()
        pivot = self.depth * rotation[2] - rotation.T @ translation
        return np.column_stack([turned, self.depth * np.array([0, 0, 1]) - turned @ (pivot + self.shift)])

    def gradients(self, pose: Floats, by_shift: Floats, by_turn: Floats) -> tuple[Floats, Floats]:
        """Return derivatives by the rotation vector and by the shift, each [3], from those by a shift of all Gaussians
        and by a rotation of them about the camera.  pose: that after the move, [3, 4]."""
        about_pivot = by_turn - np.cross(self.depth * pose[2, :3], by_shift)
        return _by_vector(self.turn, about_pivot), -by_shift


def _by_vector(turn: Floats, by_turn: Floats) -> Floats:
    """Derivatives by a rotation vector from those by a small rotation after it, by the Jacobian of SO(3)."""
    angle, x, y, z = math.hypot(*turn), *turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle > 1e-4:
        first, second = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    else:
        first, second = 0.5, 1 / 6
    return np.asarray(by_turn + first * cross @ by_turn + second * cross @ cross @ by_turn)


class CameraState(ModuleState):
    """The learned changes of the poses of the training views, and of the focal lengths of their cameras.

    A view of several sizes has one row.  One factor scales both focal lengths.  Views whose lens, or pinhole camera, is
    the same in the dataset share a camera, which has the name of the first such view.
    """

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "active"

    def __init__(self, settings: CameraOptimizer, views: Sequence[View], originals: Sequence[View]) -> None:
        super().__init__()
        self.settings, self.views = settings, views
        names = tuple(dict.fromkeys(view.name for view in views))
        self.tables_of = ViewTable(TURNS, names, AXES), ViewTable(SHIFTS, names, AXES)
        first: dict[object, str] = {}
        self.cameras = {view.name: first.setdefault(view.lens or view.camera, view.name) for view in originals}
        self.rates: tuple[Schedule, Schedule, Schedule] = 0.0, 0.0, 0.0

    def can_load(self, scalars: Scalars, tables: Any) -> bool:
        return self.tables_of[0].begun(scalars)

    def start(self, run: Run) -> None:
        for table in self.tables_of:
            table.begin(self.scalars, {})
        self.scalars |= {f"{DEPTHS}/{view.name}": depth_of(view, run.scene) for view in self.views}

    def prepare(self, run: Run, last: int, trained: bool = True) -> None:
        if not trained:
            return
        names = {view.name for view in self.views}
        focal = self.settings.focal_rate(last, len({self.cameras[name] for name in names}))
        self.rates = *self.settings.rates(last, len(names)), focal
        if focal:
            require_zoom(run.original)

    def before_render(self, step: TrainingStep) -> None:
        if step.view is not None and step.number > self.settings.start:
            zoom, pose = self.factor(self.views[step.view].name), self.pose(step.view)
            step.photograph = replace(step.photograph, camera=moved_camera(step.camera, pose, zoom))

    def after_backward(self, step: TrainingStep) -> None:
        if step.view is not None and step.number > self.settings.start:
            step.save(self, pose_gradient(step.workspace, step.model, step.frame, step.pixel_sums))

    def update(self, step: TrainingStep) -> None:
        if not (wait := step.saved(self)) or step.view is None:
            return
        sums, name, (turns, shifts), number = wait(), self.views[step.view].name, self.tables_of, step.number
        move, (turn, shift, focal) = self.move(name), self.rates
        by_turn, by_shift = move.gradients(self.pose(step.view), sums[:3], sums[3:6])
        turns.update(self.scalars, name, by_turn, at_step(turn, number))
        shifts.update(self.scalars, name, by_shift, move.depth * at_step(shift, number))
        self.zoom(name, float(sums[6]), at_step(focal, number))

    def zoom(self, view: str, by_log: float, rate: float) -> None:
        """Change the focal lengths of a view's camera by Adam; by_log: the derivative by the logarithm of a factor."""
        if rate:
            key = self._key(view)
            adam_step(self.scalars, {key: self.scalars.get(key, 0.0)}, {key: by_log}, rate)

    @property
    def zoomed(self) -> list[str]:
        """The cameras whose focal lengths have been learned."""
        return [one for one in dict.fromkeys(self.cameras.values()) if self._key(one) in self.scalars]

    def move(self, view: str) -> Move:
        """Return how far the camera of a view has moved."""
        turn, shift = (table.row(self.scalars, view) for table in self.tables_of)
        return Move(turn, shift, self.scalars[f"{DEPTHS}/{view}"])

    def pose(self, view: int) -> Floats:
        """Return the pose, [3, 4], of a training view by its number."""
        move = self.move(self.views[view].name)
        pose: Floats = np.asarray(self.views[view].world_to_camera, np.float64)
        return move.of(pose) if move.turn.any() or move.shift.any() else pose

    def factor(self, view: str) -> float:
        """Return what the focal lengths of a view are multiplied by."""
        return math.exp(self.scalars.get(self._key(view), 0.0))

    def _key(self, view: str) -> str:
        return f"{FOCALS}/{self.cameras.get(view, view)}/log"

    def apply_to(self, scene: Scene) -> Scene:
        """Return a scene with the learned cameras.

        Views that were not trained on have the focal lengths of their camera; they are moved as those of the training
        views are as a whole: about their mean, by the scale between the centers before and after.  Their rotations
        stay, as the mean of the learned ones does.
        """
        if not self.views:
            return scene
        learned = {view.name: self.pose(number) for number, view in enumerate(self.views)}
        before = np.array([view.position for view in self.views])
        after = np.array([_center(learned[view.name]) for view in self.views])
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
            camera = view.camera.zoomed(self.factor(view.name))
            return replace(view, world_to_camera=pose(view), camera=camera)

        return with_cameras(scene, list(map(found, scene.views)))

    def write(self, run: Run) -> None:
        """Write the poses that each photograph has for the model; log how far they have moved."""
        views, names = self.apply_to(run.original).views, {view.name for view in self.views}
        cameras = self.zoomed
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
        moves = [self.move(view) for view in self.tables_of[0].views]
        turns, shifts = (
            [math.hypot(*move.turn) for move in moves],
            [math.hypot(*move.shift) / move.depth for move in moves],
        )
        LOG.info(
            "poses of %d photographs in %s: turned by up to %.3f°, shifted by up to %.2g of the depth; "
            "medians %.3f°, %.2g",
            *(len(names), VIEW_POSES, math.degrees(max(turns)), max(shifts)),
            *(math.degrees(float(np.median(turns))), float(np.median(shifts))),
        )
        if cameras:
            factors = [self.factor(camera) for camera in cameras]
            LOG.info(
                "focal lengths of %s: times %s", pluralize(len(cameras), "camera"), _range(min(factors), max(factors))
            )


def require_zoom(scene: Scene) -> None:
    """Raise DataError where a view has a lens that cannot be written with another focal length."""
    for view in scene.views:
        if view.lens is not None and not zooms(view.lens):
            raise DataError(
                f"{scene.path}: camera_optimizer.focal: the lens of {quote(view.name)}, {view.lens.model}, cannot be "
                "written with another focal length; `clsplat data undistort` first, or leave out camera_optimizer.focal"
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


def pose_gradient(workspace: Workspace, model: DeviceModel, frame: Frame, pixel_sums: Array) -> Callable[[], Floats]:
    """Return a wait for the derivatives of the losses by a shift of all Gaussians and by a turn of them about the
    camera, in the axes of the world, and by the logarithm of a factor of its focal lengths, [7], from a frame's sums
    over pixels, [PIXEL_SUMS, S]."""
    device = workspace.device
    items = -(-model.gaussians.count // int(device.tuning["LANES"]))
    sums = workspace.array("pose sums", (SUMS, -(-items // GROUP)))
    device.program("poses.cl", **model.defines).pose_gradient(
        items=items, **shape_arguments(frame.drawn, frame.camera), splats=frame.splats, pixel_sums=pixel_sums, sums=sums
    )
    copied = sums.get_later()
    return lambda: np.cumsum(copied(), axis=1, dtype=np.float64)[:, -1]


def _center(pose: Floats) -> Floats:
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def _range(low: float, high: float) -> str:
    return f"{low:.4f}" if low == high else f"{low:.4f} to {high:.4f}"


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
            f"{path}: {quote(view.name)} has no pose of 3 rows of 4 numbers with a rotation, or no two focal lengths "
            f"within {MOST_ZOOM:g} times those of its camera; train again, or remove the file"
        ) from error
