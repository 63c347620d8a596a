"""The places and focal lengths of the photographs' cameras while a model is trained, and their derivatives."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from clsplat.gaussians.tables import DeviceModel
from clsplat.opencl.device import Array
from clsplat.opencl.program import constants
from clsplat.render.arguments import shape_arguments
from clsplat.render.camera import moved_camera
from clsplat.render.rasterizer import Frame
from clsplat.render.workspace import Workspace
from clsplat.scene.view import View
from clsplat.schedule import Schedule, at_step
from clsplat.views.focal_lengths import NO_FOCALS, FocalLengths
from clsplat.views.photographs import Photograph
from clsplat.views.poses import Floats, Move
from clsplat.views.view_table import ViewTable

TURNS, SHIFTS, DEPTHS, AXES = "pose_turns", "pose_shifts", "pose_depths", ("x", "y", "z")
SUMS, GROUP = (int(constants("poses.cl")[name]) for name in ("POSE_SUMS", "POSE_GROUP"))


@dataclass(frozen=True)
class PhotographPoses:
    """The training views, and the tables of what is added to their poses; a view of several sizes has one row."""

    views: Sequence[View]  # by number
    start: int = 0  # global step after which they are learned
    turn_rate: Schedule = 0.0  # rad
    shift_rate: Schedule = 0.0  # shares of the depth
    focals: FocalLengths = NO_FOCALS

    @cached_property
    def tables(self) -> tuple[ViewTable, ViewTable]:
        """The tables of rotation vectors in rad and of shifts in scene units, in the axes of the world."""
        names = tuple(dict.fromkeys(view.name for view in self.views))
        return ViewTable(TURNS, names, AXES), ViewTable(SHIFTS, names, AXES)

    def begun(self, numbers: Mapping[str, float]) -> bool:
        """Whether the numbers hold the tables."""
        return self.tables[0].begun(numbers)

    def begin(self, numbers: dict[str, float], depths: Mapping[str, float]) -> None:
        """Set the numbers before the first step.  depths: by view, scene units; see Move."""
        for table in self.tables:
            table.begin(numbers, {})
        numbers.update({f"{DEPTHS}/{view}": depths[view] for view in self.tables[0].views})

    def move(self, numbers: Mapping[str, float], view: str) -> Move:
        """Return how far the camera of a view has moved."""
        turn, shift = (table.row(numbers, view) for table in self.tables)
        return Move(turn, shift, numbers[f"{DEPTHS}/{view}"])

    def pose(self, numbers: Mapping[str, float], view: int) -> Floats:
        """Return the pose, [3, 4], of a training view by its number."""
        move = self.move(numbers, self.views[view].name)
        pose: Floats = np.asarray(self.views[view].world_to_camera, np.float64)
        return move.of(pose) if move.turn.any() or move.shift.any() else pose

    def place(self, photograph: Photograph, numbers: Mapping[str, float], step: int) -> Photograph:
        """Return a photograph with its camera as it is at a global step."""
        number = photograph.camera.view
        if number is None or step <= self.start:
            return photograph
        zoom = self.focals.factor(numbers, self.views[number].name)
        return replace(photograph, camera=moved_camera(photograph.camera, self.pose(numbers, number), zoom))

    def learning(
        self, workspace: Workspace, model: DeviceModel, frame: Frame, pixel_sums: Array, step: int
    ) -> Callable[[dict[str, float]], None] | None:
        """Begin the derivatives by the camera of a frame; return what changes the numbers, or None where they stay."""
        number = frame.camera.view
        if number is None or step <= self.start:
            return None
        waiting = pose_gradient(workspace, model, frame, pixel_sums)
        return lambda numbers: self._learn(numbers, number, waiting(), step)

    def _learn(self, numbers: dict[str, float], number: int, sums: Floats, step: int) -> None:
        name, (turns, shifts) = self.views[number].name, self.tables
        move = self.move(numbers, name)
        by_turn, by_shift = move.gradients(self.pose(numbers, number), sums[:3], sums[3:6])
        turns.update(numbers, name, by_turn, at_step(self.turn_rate, step))
        shifts.update(numbers, name, by_shift, move.depth * at_step(self.shift_rate, step))
        self.focals.update(numbers, name, float(sums[6]), step)


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
