"""How the places of the cameras are learned with the model, and how a pipeline file says so."""

import math
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
REACH = 0.01  # rad, and shares of the extent: what a photograph's visits must be enough for


class Poses(Settings):
    """Turn and shift the camera of each photograph a little, learned with the model, where poses are not exact.

    A photograph has a rotation vector and a shift of its centre in the axes of the world, by Adam, all 0 at first.  A
    step changes those of its photograph; then their means over the photographs are subtracted: what moves all cameras
    alike would be the same to every loss if the Gaussians moved too.  The world filter, rules that compare the model
    with photographs, and the extent are those of the dataset's cameras.  A sky cannot be learned with it.

    It is for poses of a phone's tracking, or where structure from motion left errors of more than a pixel.  Poses of
    structure from motion are mostly better than what training makes of them.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"turn", "shift", "start"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})

    turn: Annotated[Literal["auto"] | NonNegative, explained(", or auto")] = "auto"
    """Learning rate of the rotations in rad, by step; auto: 2e-4 to 2e-6, where photographs are seldom visited as large
    as 0.01 rad needs, up to 2e-3."""
    shift: Annotated[Literal["auto"] | NonNegative, explained(", or auto")] = "auto"
    """Learning rate of the shifts as a share of the scene's extent, by step; auto: as that of the rotations."""
    start: Annotated[int, Field(ge=0)] = 500
    """Global step after which poses are learned: before it the model is a blur, which tells nothing of them."""

    def rates(self, last: int, photographs: int) -> tuple[Schedule, Schedule]:
        """Return the learning rates by step of rotations and shifts, of a training up to a step of so many
        photographs."""
        steps = max(last - self.start, 1)
        visits = steps / photographs
        needed = REACH * math.log(FALL) * FALL / (FALL - 1) / visits  # the sum of rates that fall so far is REACH
        initial = min(max(RATE, needed), MOST)
        auto = Decay(initial=initial, final=initial / FALL, over=steps, start=self.start)
        return (auto if self.turn == "auto" else self.turn), (auto if self.shift == "auto" else self.shift)


def moved(world_to_camera: Floats, turn: Floats, shift: Floats) -> Floats:
    """Return a pose, [3, 4], with its camera turned by a rotation vector and its centre shifted: W exp([turn]x)."""
    rotation = world_to_camera[:, :3]
    centre = shift - rotation.T @ world_to_camera[:, 3]
    turned = rotation @ scipy.spatial.transform.Rotation.from_rotvec(turn).as_matrix()
    return np.column_stack([turned, -turned @ centre])


def gradients(turn: Floats, by_shift: Floats, by_turn: Floats) -> tuple[Floats, Floats]:
    """Return derivatives by the rotation vector and by the shift, each [3], from those by a shift of all Gaussians and
    by a rotation of them about the camera after `turn`."""
    angle, x, y, z = math.hypot(*turn), *turn
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle > 1e-4:
        first, second = (1 - math.cos(angle)) / angle**2, (angle - math.sin(angle)) / angle**3
    else:
        first, second = 0.5, 1 / 6
    return by_turn + first * cross @ by_turn + second * cross @ cross @ by_turn, -by_shift
