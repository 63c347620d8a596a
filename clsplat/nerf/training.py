"""Train a field: the losses of a step's rays, Adam, the tables of a checkpoint, and the memory plan."""

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from clsplat.core.errors import ConfigError, DataError, MemoryLimitError
from clsplat.nerf.field import Field, RandomKey, RayTarget, rays_per_pass
from clsplat.nerf.network import CHUNK, PLACE_ROWS
from clsplat.nerf.shape import COLOR_ROWS, SAMPLES, FieldShape, GridShape, WrittenShape
from clsplat.opencl.device import Array, constants
from clsplat.photos.photographs import Photograph
from clsplat.render.camera import DeviceCamera
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.scene.viewpoint import scene_center
from clsplat.training.field import Tables, TrainedField
from clsplat.training.memory import DeviceLimits

TABLES = ("parameters", "moment1", "moment2")
CHANNELS = 3
_WRITTEN: TypeAdapter[FieldShape] = TypeAdapter(WrittenShape)


@dataclass(frozen=True)
class RayPhotograph:
    """A photo of a step, on the device, and the number of rays to sample from it."""

    camera: DeviceCamera
    photograph: Photograph
    rays: int
    weight: float  # weight of each ray: the area of its pixel, px^2 at full resolution


@dataclass(frozen=True)
class AdamStep:
    """The settings of an Adam update."""

    rate: float
    epsilon: float = 1e-8  # added to the root of the second moment; the default of Adam's paper, also in Mip-NeRF


class LearnedField(TrainedField):
    """A field with Adam's moments, as tables for a checkpoint."""

    kind = "nerf"

    def __init__(self, field: Field) -> None:
        self.field = field
        device, count = field.parameters.device, field.shape.table_length
        self._arrays = dict(zip(TABLES, (field.parameters, device.zeros(count), device.zeros(count)), strict=True))
        self._gradient = device.zeros(count)
        self._program = device.program("dense.cl")
        self._beta1, self._beta2 = constants("adam.h")["BETA1"], constants("adam.h")["BETA2"]
        self.updates = 0  # number of updates so far, for the bias correction of the moments
        self.rate = 0.0  # rate of the last step
        self._scales: list[tuple[int, float]] = []  # rays and factor on squared differences, by photo of the last step

    @classmethod
    def initial(cls, shape: FieldShape, seed: int, background: Array) -> "LearnedField":
        """Return an untrained field for a seed.  background: RGB, [3], in [0, 1]."""
        return cls(Field.initial(shape, seed, background))

    @classmethod
    def from_tables(
        cls, shape: Mapping[str, Any], tables: Mapping[str, NDArray[np.float32]], background: Array
    ) -> Self:
        """Return the field of a checkpoint.  tables: the result of the method `tables`."""
        parsed_shape = _parse_shape(shape)
        field = cls(Field(parsed_shape, background.device.zeros(parsed_shape.table_length), background))
        for name, array in field._arrays.items():
            array.set(tables[name][:, 0])
        return field

    @classmethod
    def check_tables(cls, shape: Mapping[str, Any], tables: Tables, extra_tables: Tables) -> None:
        """Raise DataError for tables that do not fit a shape."""
        if extra_tables:
            raise DataError(f"it contains {next(iter(extra_tables))} in addition to a field")
        if tables.keys() != set(TABLES):
            raise DataError(f"its field does not have the tables {', '.join(TABLES)}")
        parameters = _parse_shape(shape).table_length
        for name, table in tables.items():
            if table.dtype != np.float32 or table.shape != (parameters, 1):
                raise DataError(f"the table '{name}' of its field is not [{parameters}, 1] float32")
            if not np.isfinite(table).all():
                raise DataError(f"the table '{name}' of its field contains values that are not finite")

    @property
    def painter(self) -> Field:
        """The renderer, which is the field itself."""
        return self.field

    @property
    def parameter_count(self) -> int:
        """The number of trained parameters."""
        return self.field.shape.parameter_count

    def shape_as_data(self) -> dict[str, Any]:
        """Return the shape of the field as data for JSON."""
        return self.field.shape.model_dump()

    def tables(self) -> Tables:
        """Copy the tables of the field to the host, each [P, 1]."""
        return {name: array.get()[:, None] for name, array in self._arrays.items()}

    def find_nonfinite(self) -> list[str]:
        """Return the names of the tables that contain NaN or infinity."""
        device, count = self._gradient.device, self.field.shape.table_length
        counters = {name: device.zeros(1, np.uint32) for name in self._arrays}
        for name, array in self._arrays.items():
            device.program("check.cl").count_not_finite(
                items=(count, 1), values=array, counter=counters[name], stride=count, count=count
            )
        return [name for name, counter in counters.items() if counter.get_item(0) > 0]

    def step(self, photos: Sequence[RayPhotograph], coarse_weight: float, adam: AdamStep, seed: int, step: int) -> None:
        """Train for one step on rays of photos (Barron et al. 2021, section 3.3).

        The loss is the loss of the fine level plus `coarse_weight` times the loss of the coarse level.  Each is the
        mean squared difference of the rays, weighted by the areas of their pixels.
        """
        total = CHANNELS * sum(photo.rays * photo.weight for photo in photos)
        self.rate = adam.rate
        self._gradient.fill(0)
        errors = self._errors(sum(photo.rays for photo in photos))
        self._scales, first = [(photo.rays, photo.weight / total) for photo in photos], 0
        for photo in photos:
            self._differentiate(photo, photo.weight / total, coarse_weight, RandomKey(seed, step, first), errors)
            first += photo.rays
        self.updates += 1
        self.update(self._gradient, adam, self.updates)

    def update(self, gradient: Array, adam: AdamStep, update_number: int) -> None:
        """Update the parameters with Adam and a gradient, [P].  update_number: from 1."""
        self._program.dense_update(
            items=self.field.shape.table_length // int(self._gradient.device.tuning["LANES"]),
            parameters=self.field.parameters,
            moment1=self._arrays["moment1"],
            moment2=self._arrays["moment2"],
            gradient=gradient,
            rate=adam.rate / (1 - self._beta1**update_number),
            correction2=1 / (1 - self._beta2**update_number),
            epsilon=adam.epsilon,
            count=self.field.shape.table_length,
        )

    def loss(self, coarse_weight: float) -> tuple[float, float]:
        """Return the loss of the last step, and the mean squared difference of its fine level."""
        coarse_loss, fine_loss = (
            sum(
                scale * float(photo_errors.sum(dtype=np.float64))
                for (_, scale), photo_errors in zip(self._scales, self._split_by_photo(array.get()), strict=True)
            )
            for array in self._errors(sum(rays for rays, _ in self._scales))
        )
        return fine_loss + coarse_weight * coarse_loss, fine_loss

    def _split_by_photo(self, errors: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        return np.split(errors, np.cumsum([rays for rays, _ in self._scales])[:-1])

    def _errors(self, rays: int) -> list[Array]:
        """Return the squared differences of the rays of a step, coarse and fine."""
        return [self.field.workspace.array(f"field {name} errors", rays) for name in ("coarse", "fine")]

    def _differentiate(
        self, photo: RayPhotograph, scale: float, coarse_weight: float, draw: RandomKey, errors: list[Array]
    ) -> None:
        """Add the gradient for the rays of one photo, in passes."""
        renderer, count = self.field.ray_renderer, rays_per_pass(self.field.shape)
        colors = photo.photograph.planes(self.field.workspace).colors
        scales = coarse_weight * scale, scale
        for first in range(0, photo.rays, count):
            rays_draw = RandomKey(draw.seed, draw.step, draw.first + first)
            rays = renderer.sample_rays(photo.camera, rays_draw, min(count, photo.rays - first))
            sample_levels = renderer.render(self.field.parameters, rays)
            for level, level_scale, level_errors in zip(sample_levels, scales, errors, strict=True):
                target = RayTarget(colors, level_scale, level_errors)
                renderer.differentiate(self.field.parameters, level, target, self._gradient)


def _parse_shape(data: Mapping[str, Any]) -> FieldShape:
    """Return the shape of a field in a checkpoint.  Raises DataError if it is invalid."""
    try:
        return _WRITTEN.validate_json(json.dumps(data))
    except ValidationError as error:
        raise DataError(f"the shape of its field: {error.errors()[0]['msg']}") from None


# The device memory that training a field needs, computed before it is allocated.

TABLE_COUNT = 4  # parameters, two moments of Adam, gradient
MIB = 2**20


@dataclass(frozen=True)
class FieldPlan:
    """The device memory in bytes that training a field needs."""

    parameters: int  # one table of parameters
    features: int  # features and gradients of the samples of one pass
    partials: int  # sums of chunks of samples, for each parameter of the network
    photograph_bytes: int

    @property
    def total_bytes(self) -> int:
        """The required memory in total, with TABLE_COUNT tables of parameters."""
        return TABLE_COUNT * self.parameters + self.features + self.partials + self.photograph_bytes

    def text(self, limits: DeviceLimits) -> str:
        """Return a line of text: the required memory, and the memory of the device."""
        return (
            f"memory: {self.total_bytes / MIB:,.0f} MiB for a field ({TABLE_COUNT} tables of "
            f"{self.parameters / MIB:,.0f} MiB, "
            f"samples {(self.features + self.partials) / MIB:,.0f} MiB, photos {self.photograph_bytes / MIB:,.0f} MiB) "
            f"in {limits.memory / MIB:,.0f} MiB with buffers up to {limits.allocation / MIB:,.0f} MiB"
        )

    def check(self, limits: DeviceLimits) -> None:
        """Raise MemoryLimitError if the required memory exceeds the limits."""
        if self.total_bytes > limits.memory or max(self.parameters, self.partials) > limits.allocation:
            raise MemoryLimitError(
                f"{self.text(limits)}; this does not fit: use fewer levels or entries of the "
                "grid (train_field.field.grid), a smaller train_field.field.width, or fewer samples"
            )


def field_plan(shape: FieldShape, photograph_bytes: int) -> FieldPlan:
    """Return the memory plan for training a field.  photograph_bytes: bytes of the photos on the device."""
    samples = rays_per_pass(shape) * max(shape.coarse_samples, shape.fine_samples)
    hidden_rows = (shape.depth + 3) * shape.width  # outputs of the trunk, and gradients of three layers
    encoded_rows = shape.position_rows + shape.grid_rows + PLACE_ROWS + shape.direction_rows
    rows = hidden_rows + encoded_rows + shape.width + 2 * shape.color_width + 4 * COLOR_ROWS
    chunks = -(-samples // (SAMPLES * CHUNK))
    return FieldPlan(4 * shape.table_length, 4 * rows * samples, 4 * chunks * shape.network_length, photograph_bytes)


# Check that photos show the cube of a field's grid, since nothing is trained outside it.

Floats = NDArray[np.float64]
CORNERS = np.array(list(itertools.product((0.0, 1.0), repeat=3)))  # the corners of a cube, [8, 3]


def require_visible_grid(shape: FieldShape, scene: Scene) -> None:
    """Raise ConfigError if no training view shows the cube of a field's grid, or if all scene points are outside it.

    A view shows the cube only at depths between the shape's `near` and `far`.
    """
    cube, views, points = shape.grid, scene.split("train"), scene.points
    if cube is None or not views:
        return
    unit = shape.with_unit(scene).scene_units
    corner, side = np.array(cube.corner), cube.side
    if not any(_intersect(corner + side * CORNERS, _corners(view, shape.near, shape.far, unit)) for view in views):
        fault = f"no training view sees its cube at depths from {shape.near:g} to {shape.far:g}"
    elif points and len(points) and not _is_in_cube(cube, np.asarray(points.positions, np.float64) / unit).any():
        fault = f"none of the scene's {len(points):,} points is in its cube"
    else:
        return
    low, high, center = (_point_text(point) for point in (corner, corner + side, scene_center(views) / unit))
    raise ConfigError(
        f"train_field.field.grid: {fault}; it spans {low} to {high} in units of {unit:g} scene units, and "
        f"the cameras of {scene.path} look at {center}; set `grid.corner`, `grid.side`, `near`, and `far` to match"
    )


def _is_in_cube(cube: GridShape, positions: Floats) -> NDArray[np.bool_]:
    """Return a mask, [M], of the positions, [M, 3], inside a cube."""
    return np.asarray((np.abs(positions - (np.array(cube.corner) + cube.side / 2)) <= cube.side / 2).all(axis=1))


def _corners(view: View, near: float, far: float, unit: float) -> Floats:
    """Return the corners, [8, 3], of a view's frustum between two depths, in units of `unit`.

    They have the order of CORNERS: columns, rows, depth.
    """
    camera = view.camera
    directions = (CORNERS[:, :2] * [camera.width, camera.height] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    positions = np.column_stack([directions, np.ones(8)]) * (near + CORNERS[:, 2:] * (far - near))
    rotation, translation = view.world_to_camera[:, :3], view.world_to_camera[:, 3] / unit
    return np.asarray((positions - translation) @ rotation)


def _intersect(cube: Floats, frustum: Floats) -> bool:
    """Return whether a cube and a frustum intersect: no axis separates them (Gottschalk, Lin and Manocha 1996).

    Both are arrays of corners, [8, 3], in the order of CORNERS.
    """
    axes, edges = np.eye(3), frustum[[1, 5, 3, 7, 4, 2]] - frustum[[0, 4, 2, 6, 0, 0]]  # along the depth, row, column
    faces = np.cross(edges[[4, 4, 4, 5, 5]], edges[[5, 0, 2, 0, 1]])
    candidates = np.vstack([axes, faces, np.cross(axes[:, None], edges[None]).reshape(-1, 3)])
    cube_x, frustum_x = cube @ candidates.T, frustum @ candidates.T
    is_separating = (cube_x.max(axis=0) < frustum_x.min(axis=0)) | (frustum_x.max(axis=0) < cube_x.min(axis=0))
    return not bool(is_separating.any())


def _point_text(point: NDArray[np.floating]) -> str:
    return f"({', '.join(f'{round(float(value), 6) + 0.0:.4g}' for value in point)})"
