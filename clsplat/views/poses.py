"""How the places and focal lengths of the cameras are learned with the model, and how a pipeline file says so."""

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from pydantic import Field

from clsplat.schedule import Decay, NonNegative, Schedule, explained
from clsplat.settings import Settings

Floats = NDArray[np.float64]
RATE, MOST = 2e-4, 2e-3  # learning rates at the start
FALL = 100  # from the first rate to the last
TURN_SHARE = 0.3  # ours: what a turn about that point does in the image is little, and so mostly noise
REACH = 0.01  # shares of the depth: what a photograph's visits must be enough for
FOCAL_RATE, FOCAL_MOST = 1e-4, 1e-3  # the same of the logarithms of focal lengths
FOCAL_REACH = 0.2  # of them: noise takes most of the way to a change of a few hundredths


class Poses(Settings):
    """Turn and shift the camera of each photograph a little, learned with the model, where poses are not exact.

    A photograph has a rotation vector and a shift in the axes of the world, by Adam, all 0 at first.  The camera turns
    about the point of its axis at the median depth of the dataset's points; without points, at the extent.  A step
    changes those of its photograph; then their means over the photographs are subtracted: what moves all cameras alike
    would be the same to every loss if the Gaussians moved too.  The world filter, rules that compare the model with
    photographs, and the extent are those of the dataset's cameras.  A sky cannot be learned with it.

    With `focal`, photographs that share a camera in the dataset share a factor of both of its focal lengths.  It has no
    mean to subtract: a single camera may change.  What stays with poses stays with it too, and so does the principal
    point.  Where cameras walk ahead, a focal length is little else than depth: leave it then.

    It is for poses of a phone's tracking, or where structure from motion left errors of more than a pixel.  Poses of
    structure from motion are mostly better than what training makes of them.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"turn", "shift", "focal", "start"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})

    turn: Annotated[Literal["auto"] | NonNegative, explained(", or auto")] = "auto"
    """Learning rate of the rotations in rad, by step; auto: 0.3 times the automatic one of the shifts."""
    shift: Annotated[Literal["auto"] | NonNegative, explained(", or auto")] = "auto"
    """Learning rate of the shifts as a share of that depth, by step; auto: 2e-4 to 2e-6, where photographs are seldom
    visited as large as a shift of 0.01 needs, up to 2e-3."""
    focal: Annotated[Literal["auto"] | NonNegative, explained(", or auto")] = 0.0
    """Learning rate of the logarithms of focal lengths, by step; 0: they stay.  auto: 1e-4 to 1e-6, where cameras are
    seldom visited so large that the rates of a camera's visits add up to 0.2, up to 1e-3."""
    start: Annotated[int, Field(ge=0)] = 500
    """Global step after which poses are learned: before it the model is a blur, which tells nothing of them."""

    def rates(self, last: int, photographs: int) -> tuple[Schedule, Schedule]:
        """Return the learning rates by step of rotations and shifts, of a training up to a step of so many
        photographs."""
        shift = self._falling(last, photographs, REACH, (RATE, MOST))
        turn = shift.divided(1 / TURN_SHARE)
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


@dataclass(frozen=True)
class Move:
    """A rotation vector and a shift, each [3], of a camera in the axes of the world.

    The camera turns about the point of its axis at a depth, where photographs show the scene: about its own centre a
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
