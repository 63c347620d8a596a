"""Optimize camera poses and focal lengths together with the model."""

import json
import logging
import math
from collections.abc import Mapping, Sequence
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
from clsplat.photos.appearance import ViewTable, adam_step
from clsplat.render.camera import move_camera
from clsplat.render.rasterizer import pose_gradient
from clsplat.scene.quality import points_in_image
from clsplat.scene.reprojection import replace_cameras
from clsplat.scene.scene import Scene
from clsplat.scene.view import View, can_zoom
from clsplat.training.modules.base import ModuleState, Scalars, TrainingModule, TrainingStep
from clsplat.training.run import Run

Floats = NDArray[np.float64]
VIEW_POSES = "view_poses.json"
ROTATIONS, TRANSLATIONS, DEPTHS, FOCALS = "rotations", "translations", "depths", "focal_lengths"
AXES = "x", "y", "z"
RATE, MAX_RATE = 2e-4, 2e-3  # initial learning rates
RATE_RATIO = 100  # ratio of the initial rate to the final rate
ROTATION_RATIO = 0.3  # our choice; the gradient of a rotation about the pivot is small and mostly noise
REACH = 0.01  # smallest sum of the rates of a photo's visits, relative to the depth
FOCAL_RATE, MAX_FOCAL_RATE = 1e-4, 1e-3  # initial learning rates of the logarithms of focal lengths
FOCAL_REACH = 0.2  # smallest sum of the rates of a camera's visits: most updates are noise, changes a few hundredths
MIN_POINTS = 10  # number of points that are required for a median depth
MAX_ZOOM = 10.0  # largest factor on a focal length in a side file
LOG = logging.getLogger("clsplat")


class CameraOptimizer(TrainingModule):
    """Optimize the camera pose of each photograph together with the model.

    Each photograph has a rotation vector and a translation in world axes, trained by Adam from 0.  The camera rotates
    about the point on its optical axis at the median depth of the dataset's points, or at the scene's extent if
    there are too few points.
    A step updates its photograph's pose and then subtracts the means over all photographs, because losses cannot detect
    a motion that all cameras share with the Gaussians.  The world filter, the extent, and rules that compare the model
    with photographs use the dataset's cameras.

    With `focal`, the photographs of one camera share a factor for both of its focal lengths; the principal point is
    fixed.  Factors are not centered, so a single camera can change.  Omit `focal` if cameras move straight ahead,
    because focal length is then hard to distinguish from depth.

    Use this module for poses from a phone's tracking, or if the reprojection errors of structure from motion exceed a
    pixel.  Otherwise, the poses from structure from motion are usually better than optimized poses.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rotation", "translation", "focal", "start"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})
    conflicts: ClassVar[Mapping[str, str]] = {
        "sky": "a sky cannot be learned together with poses",
        "inverse_depth": "its gradient does not reach the poses",
        "blocks": "the poses of blocks would differ",
    }
    side_files: ClassVar[Mapping[str, str]] = {VIEW_POSES: "poses"}

    type: Literal["camera_optimizer"] = "camera_optimizer"
    rotation: Annotated[Literal["auto"] | NonNegative, explain_schedule(", or auto")] = "auto"
    """Learning rate of rotations, rad; may be scheduled.  auto: 0.3 times the automatic rate of translations."""
    translation: Annotated[Literal["auto"] | NonNegative, explain_schedule(", or auto")] = "auto"
    """Learning rate of translations, relative to the median depth; may be scheduled.  auto: decays from 2e-4 to
    2e-6; if photos have few visits, it starts at up to 2e-3, so that the rates of each photo add up to 0.01."""
    focal: Annotated[Literal["auto"] | NonNegative, explain_schedule(", or auto")] = 0.0
    """Learning rate of the logarithms of focal lengths; may be scheduled; 0: fixed.  auto: decays
    from 1e-4 to 1e-6; if cameras have few visits, it starts at up to 1e-3, so that the rates of each add up to 0.2."""
    start: Annotated[int, Field(ge=0)] = 500
    """Global step after which poses are optimized; before it, the model is too blurry to align cameras."""

    def rates(self, last: int, photographs: int) -> tuple[Schedule, Schedule]:
        """Return the rate schedules for rotations and translations.  last: global step at which training ends."""
        translation = self._decay(last, photographs, REACH, (RATE, MAX_RATE))
        rotation = translation.divide(1 / ROTATION_RATIO)
        return (
            rotation if self.rotation == "auto" else self.rotation,
            translation if self.translation == "auto" else self.translation,
        )

    def focal_rate(self, last: int, cameras: int) -> Schedule:
        """Return the rate schedule for focal lengths.  last: global step at which training ends."""
        automatic = self._decay(last, cameras, FOCAL_REACH, (FOCAL_RATE, MAX_FOCAL_RATE))
        return automatic if self.focal == "auto" else self.focal

    def _decay(self, last: int, rows: int, reach: float, bounds: tuple[float, float]) -> Decay:
        """Return a decaying rate whose values at the visits of one photograph, or one camera, add up to `reach`.

        rows: number of photographs or cameras; bounds: limits of the initial rate, which take precedence over `reach`.
        """
        steps = max(last - self.start, 1)
        visits = steps / rows
        min_rate = reach * math.log(RATE_RATIO) * RATE_RATIO / (RATE_RATIO - 1) / visits
        initial = min(max(bounds[0], min_rate), bounds[1])
        return Decay(initial=initial, final=initial / RATE_RATIO, over=steps, start=self.start)

    def check_run(self, run: Run) -> None:
        if self.focal:
            require_zoom(run.original)

    def create_state(self, run: Run) -> "CameraState":
        return CameraState(self, run.scene.split("train"), run.original.views)

    @classmethod
    def apply_side_files(cls, model: Path, scene: Scene) -> Scene:
        """Return `scene`, which must be at full size, with the poses and focal lengths of a model's side file."""
        path = model.with_name(VIEW_POSES)
        if not path.is_file():
            return scene
        data = read_json(path, "poses of photos")
        rows = data.get("photographs") if isinstance(data, dict) else None
        if not isinstance(rows, dict):
            raise DataError(f"{path}: expected a mapping 'photographs'; train again, or remove the file")
        return replace_cameras(
            scene, [_with_pose(path, view, rows.get(view.name), scene.origin) for view in scene.views]
        )


@dataclass(frozen=True)
class PoseChange:
    """A change of a camera's pose: a rotation vector and a translation in world axes, each [3].

    The camera rotates about a pivot, the point on its optical axis at `depth`.  A rotation about the camera's center
    would change the image almost like a translation.  Adam, which works per coordinate, could not separate the two.
    """

    rotation: Floats  # rad
    translation: Floats  # scene units
    depth: float  # scene units

    def apply_to(self, world_to_camera: Floats) -> Floats:
        """Return the changed pose, [3, 4].  Only the translation moves the pivot.

        The changed rotation is W exp([rotation]x), where W is the rotation of `world_to_camera`.
        """
        old = world_to_camera[:, :3]
        new = old @ scipy.spatial.transform.Rotation.from_rotvec(self.rotation).as_matrix()
        pivot = self.depth * old[2] - old.T @ world_to_camera[:, 3]
        return np.column_stack([new, self.depth * np.array([0, 0, 1]) - new @ (pivot + self.translation)])

    def gradients(self, pose: Floats, grad_translation: Floats, grad_rotation: Floats) -> tuple[Floats, Floats]:
        """Return the gradients of the rotation vector and of the translation, each [3].

        pose: the changed pose, [3, 4]; grad_translation, grad_rotation: gradients with respect to a translation of all
        Gaussians, and to a rotation of all Gaussians about the camera, [3].
        """
        grad_pivot = grad_rotation - np.cross(self.depth * pose[2, :3], grad_translation)
        return _rotation_vector_gradient(self.rotation, grad_pivot), -grad_translation


def _rotation_vector_gradient(vector: Floats, grad_rotation: Floats) -> Floats:
    """Return the gradient of a rotation vector from that of a small rotation after it (right Jacobian of SO(3))."""
    angle, x, y, z = math.hypot(*vector), *vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle > 1e-4:
        first, second = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    else:
        first, second = 0.5, 1 / 6
    return np.asarray(grad_rotation + first * cross @ grad_rotation + second * cross @ cross @ grad_rotation)


class CameraState(ModuleState):
    """The learned changes of the training views' poses and of their cameras' focal lengths.

    All image sizes of a view share a row of parameters.  A single factor scales both focal lengths.  Views with the
    same lens or the same pinhole camera in the dataset share a camera, which has the name of the first such view.
    """

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "active"

    def __init__(self, settings: CameraOptimizer, views: Sequence[View], originals: Sequence[View]) -> None:
        super().__init__()
        self.settings, self.views = settings, views
        names = tuple(dict.fromkeys(view.name for view in views))
        self.pose_tables = ViewTable(ROTATIONS, names, AXES), ViewTable(TRANSLATIONS, names, AXES)
        names_by_lens: dict[object, str] = {}
        self.cameras = {view.name: names_by_lens.setdefault(view.lens or view.camera, view.name) for view in originals}
        self.rates: tuple[Schedule, Schedule, Schedule] = 0.0, 0.0, 0.0

    def can_load(self, scalars: Scalars, tables: Any) -> bool:
        return self.pose_tables[0].is_in(scalars)

    def start(self, run: Run) -> None:
        for table in self.pose_tables:
            table.begin(self.scalars, {})
        self.scalars |= {f"{DEPTHS}/{view.name}": median_depth(view, run.scene) for view in self.views}

    def prepare(self, run: Run, last_step: int, is_trained: bool = True) -> None:
        if not is_trained:
            return
        names = {view.name for view in self.views}
        zoom_rate = self.settings.focal_rate(last_step, len({self.cameras[name] for name in names}))
        self.rates = *self.settings.rates(last_step, len(names)), zoom_rate
        if zoom_rate:
            require_zoom(run.original)

    def before_render(self, step: TrainingStep) -> None:
        if step.view_index is not None and step.number > self.settings.start:
            zoom, pose = self.factor(self.views[step.view_index].name), self.pose(step.view_index)
            step.photograph = replace(step.photograph, camera=move_camera(step.workspace, step.camera, pose, zoom))

    def after_backward(self, step: TrainingStep) -> None:
        if step.view_index is not None and step.number > self.settings.start:
            step.save(self, pose_gradient(step.workspace, step.model, step.frame, step.pixel_sums))

    def update(self, step: TrainingStep) -> None:
        if not (download := step.saved_value(self)) or step.view_index is None:
            return
        sums, name, (rotations, translations) = download(), self.views[step.view_index].name, self.pose_tables
        change = self.pose_change(name)
        rotation_rate, translation_rate, zoom_rate = (at_step(r, step.number) for r in self.rates)
        grad_rotation, grad_translation = change.gradients(self.pose(step.view_index), sums[:3], sums[3:6])
        rotations.update(self.scalars, name, grad_rotation, rotation_rate)
        translations.update(self.scalars, name, grad_translation, change.depth * translation_rate)
        self.zoom(name, float(sums[6]), zoom_rate)

    def zoom(self, view: str, grad_log: float, rate: float) -> None:
        """Update the focal lengths of a view's camera with Adam.  grad_log: gradient of the logarithm of the factor."""
        if rate:
            key = self._key(view)
            adam_step(self.scalars, {key: self.scalars.get(key, 0.0)}, {key: grad_log}, rate)

    @property
    def zoomed_cameras(self) -> list[str]:
        """The names of the cameras with learned focal lengths."""
        return [camera for camera in dict.fromkeys(self.cameras.values()) if self._key(camera) in self.scalars]

    def pose_change(self, view: str) -> PoseChange:
        """Return the learned change of the pose of a view."""
        rotation, translation = (table.row(self.scalars, view) for table in self.pose_tables)
        return PoseChange(rotation, translation, self.scalars[f"{DEPTHS}/{view}"])

    def pose(self, view: int) -> Floats:
        """Return the learned pose of a training view, [3, 4].  view: the index of the view."""
        change = self.pose_change(self.views[view].name)
        pose: Floats = np.asarray(self.views[view].world_to_camera, np.float64)
        return change.apply_to(pose) if change.rotation.any() or change.translation.any() else pose

    def factor(self, view: str) -> float:
        """Return the learned factor by which a view's focal lengths are multiplied."""
        return math.exp(self.scalars.get(self._key(view), 0.0))

    def _key(self, view: str) -> str:
        return f"{FOCALS}/{self.cameras.get(view, view)}/log"

    def apply_to(self, scene: Scene) -> Scene:
        """Return `scene`, which must be at full size, with the learned cameras.

        Other views get the focal lengths of their camera, and follow the common motion of the training views: their
        centers are scaled about the mean center.  Their rotations do not change, since learned rotations have a zero
        mean.
        """
        if not self.views:
            return scene
        poses = {view.name: self.pose(index) for index, view in enumerate(self.views)}
        centers = np.array([view.position for view in self.views])
        new_centers = np.array([_center(poses[view.name]) for view in self.views])
        mean, new_mean = centers.mean(axis=0), new_centers.mean(axis=0)
        offsets = centers - mean
        spread = float((offsets**2).sum())
        scale = float((offsets * (new_centers - new_mean)).sum()) / spread if spread > 0 else 1.0

        def pose(view: View) -> Floats:
            if view.name in poses:
                return poses[view.name]
            rotation = view.world_to_camera[:, :3]
            return np.column_stack([rotation, -rotation @ (new_mean + scale * (view.position - mean))])

        views = (replace(view, camera=view.camera.zoomed(self.factor(view.name))) for view in scene.views)
        return replace_cameras(scene, [replace(view, world_to_camera=pose(view)) for view in views])

    def write(self, run: Run) -> None:
        """Write the pose of each photograph, and log how far the cameras have moved."""
        views, names = self.apply_to(run.original).views, {view.name for view in self.views}
        cameras = self.zoomed_cameras
        data = {
            "meaning": "optimized poses, rows of [R | t], world to camera; learned: true for training photos; "
            "others follow their common motion"
            + ("; focal_lengths: in x and y, px, at the full size of the undistorted photos" if cameras else ""),
            "photographs": {
                view.name: {
                    "learned": view.name in names,
                    "world_to_camera": view.shifted(-run.original.origin).world_to_camera.tolist(),
                    **({"focal_lengths": [view.camera.fx, view.camera.fy]} if cameras else {}),
                }
                for view in views
            },
        }
        write_text(run.out / VIEW_POSES, json.dumps(data, indent=1) + "\n")
        changes = [self.pose_change(view) for view in self.pose_tables[0].views]
        angles = [math.degrees(math.hypot(*change.rotation)) for change in changes]
        distances = [math.hypot(*change.translation) / change.depth for change in changes]
        LOG.info(
            "poses of %d photos in %s: rotated by up to %.3f° (median %.3f°), moved by up to %.2g of the depth "
            "(median %.2g)",
            *(len(names), VIEW_POSES, max(angles), np.median(angles), max(distances), np.median(distances)),
        )
        if cameras:
            factors = [self.factor(camera) for camera in cameras]
            scale = _format_range(min(factors), max(factors))
            LOG.info("scaled focal lengths of %s by %s", pluralize(len(cameras), "camera"), scale)


def require_zoom(scene: Scene) -> None:
    """Raise DataError if a view has a lens whose focal length cannot be optimized."""
    for view in scene.views:
        if view.lens is not None and not can_zoom(view.lens):
            raise DataError(
                f"{scene.path}: camera_optimizer.focal: the focal length of {quote(view.name)}'s lens, "
                f"{view.lens.model}, cannot be optimized; run `clsplat data undistort` first, or remove this key"
            )


def median_depth(view: View, scene: Scene) -> float:
    """Return the median depth of the scene's points in a view, or the scene's extent if there are too few points."""
    depths = points_in_image(view, scene.points)
    return float(np.median(depths)) if len(depths) >= MIN_POINTS else float(scene.extent)


def _center(pose: Floats) -> Floats:
    return np.asarray(-pose[:, :3].T @ pose[:, 3])


def _format_range(low: float, high: float) -> str:
    return f"{low:.4f}" if low == high else f"{low:.4f} to {high:.4f}"


def _with_pose(path: Path, view: View, row: Any, origin: NDArray[np.floating]) -> View:
    """Return a view with the camera in `row` of a side file, shifted to `origin`; unchanged if there is no row."""
    if row is None:
        return view
    try:
        fx, fy = map(float, row.get("focal_lengths", (view.camera.fx, view.camera.fy)))
        if not all(1 / MAX_ZOOM <= zoom <= MAX_ZOOM for zoom in (fx / view.camera.fx, fy / view.camera.fy)):
            raise ValueError("focal lengths out of range")
        camera = replace(view.camera, fx=fx, fy=fy).check()
        pose = np.array(row["world_to_camera"], np.float64)
        return replace(view, world_to_camera=pose, camera=camera).shifted(origin)
    except (AttributeError, KeyError, TypeError, ValueError, PoseError) as error:
        raise DataError(
            f"{path}: {quote(view.name)} has no valid pose of 3 rows of 4 numbers, or no focal lengths within "
            f"{MAX_ZOOM:g} times those of its camera; train again, or remove the file"
        ) from error
