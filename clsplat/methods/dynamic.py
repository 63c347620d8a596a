"""Rules for Gaussians that move: two of half the time for those that travel far, none for those that no view shows."""

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Positive, at_step
from clsplat.density.edit import Edit, Rule
from clsplat.formats.splats import MOTION, fields_of, opacities
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.motion import moved_to, presence
from clsplat.losses.base import LossValue, Penalty, PenaltyInputs
from clsplat.methods.adc import Grow

APART = 0.6  # of each child from the center, in durations
SHORTER = 0.8  # its duration by that of the Gaussian: the variance of both together, 0.6² + 0.8², is that of the one
LONGEST = 0.5  # duration that is divided: of those that are there always, half the scene
MOST = 1 - 1e-6  # opacity


class SplitInTime(Grow):
    """Divide Gaussians whose statistic is large in time, where they travel farther than their size (ours).

    What follows a curve, or changes on its way, is two then: each with its own velocity, one before the other.  Where
    the time at the center is the same for both, they are together as opaque as it was.
    """

    type: Literal["split_in_time"] = "split_in_time"
    training_keys: ClassVar[frozenset[str]] = frozenset({"travel_above", "duration_above"})

    travel_above: Positive = 1.0
    """Smallest way in its duration, by the largest standard deviation of the Gaussian; by step."""
    duration_above: Annotated[float, Field(gt=0)] = 0.1
    """Smallest duration that is divided, by the scene's duration."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        require_motion(self.type, gaussians)
        steep = edit.stats.mean(self.statistic) >= self.condition(edit)["gradient_above"]
        rows = np.flatnonzero(steep & (edit.rows() == 1))
        names = ("means", "quats", "log_scales", "logit_opacity", MOTION)
        tables = {name: gaussians.get(name)[rows].astype(np.float64) for name in names}
        fields = fields_of(tables[MOTION].shape[1])
        duration = np.minimum(np.exp(np.minimum(tables[MOTION][:, fields["log_duration"]][:, 0], 0)), LONGEST)
        travel = np.linalg.norm(tables[MOTION][:, fields["velocity"]], axis=1) * duration
        size = np.exp(tables["log_scales"]).max(axis=1)
        far = (travel > edit.at(self.travel_above) * size) & (duration > self.duration_above)
        rows, duration = rows[far], duration[far]
        if not len(rows):
            return
        tables = {name: table[far] for name, table in tables.items()}
        ends = [moved_to(tables, way * APART * duration) for way in (-1, 1)]
        for end in ends:
            end[MOTION][:, fields["log_duration"]] = np.log(SHORTER * duration)[:, None]
            end["logit_opacity"] = shared_in_time(tables["logit_opacity"])
        chosen = np.zeros(gaussians.count, bool)
        chosen[rows] = True
        edit.choose(chosen, copies=2, kept=0)
        for name in ("means", "quats", "logit_opacity", MOTION):
            edit.set_children(name, rows, np.stack([end[name] for end in ends], axis=1))


class PruneInvisible(Rule):
    """Remove Gaussians that are almost transparent at each moment of the training views."""

    type: Literal["prune_invisible"] = "prune_invisible"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"opacity_below"})

    opacity_below: Positive = 0.005
    """Largest opacity, at the moment nearest to its time, below which a Gaussian is removed; by step."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        require_motion(self.type, gaussians)
        moments = np.unique([view.time or 0.0 for view in edit.survey.views])
        motion = gaussians.get(MOTION)
        centers = motion[:, fields_of(motion.shape[1])["time_center"]][:, 0]
        after = np.searchsorted(moments, centers).clip(1, max(len(moments) - 1, 1))
        near = [presence(motion, moments[np.minimum(place, len(moments) - 1)]) for place in (after - 1, after)]
        most = opacities(gaussians.get("logit_opacity")[:, 0]) * np.maximum(*near)
        edit.choose(most < edit.at(self.opacity_below), copies=0, kept=0)


def shared_in_time(logit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logits of two children that are as opaque together, at the time of their parent, as it was."""
    alone = (1 - np.sqrt(1 - np.minimum(opacities(logit), MOST))) / np.exp(-0.5 * (APART / SHORTER) ** 2)
    alone = np.clip(alone, 1 - MOST, MOST)
    return np.asarray(np.log(alone / (1 - alone)))


def require_motion(name: str, gaussians: Gaussians) -> None:
    """Raise ConfigError where a rule of motion has none."""
    if not gaussians.moves:
        raise ConfigError(f"the rule '{name}': expected Gaussians that move; give `model.time`, or leave the rule out")


# Penalties on the motion of Gaussians, which keep what stands still where it is, and what is there, there.


class MotionL2(Penalty):
    """Mean over Gaussians of min(s, 1) |v|, in extents: the way of each while it is there, s its duration (ours).

    Meant for velocities of which the photographs say little.  On the synthetic scene it lost 0.3 to 0.5 dB, beside
    `short_duration` (docs/moving.md), and no recipe has it.
    """

    type: Literal["motion_l2"] = "motion_l2"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        require_moving(self.type, inputs)
        sums = inputs.sums("motion_l2")
        weight = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count) / inputs.extent
        inputs.gaussians.device.program("motion_penalty.cl").motion_l2(
            **inputs.arguments(MOTION), sums=sums, weight=weight
        )
        return LossValue("motion_l2", lambda: weight * float(sums.get().sum(dtype="float64")))


class ShortDuration(Penalty):
    """Mean over Gaussians of max(log(s₀ / s), 0), s₀ = `below`: against durations that show one moment alone (ours).

    No recipe has it: see `motion_l2`.
    """

    type: Literal["short_duration"] = "short_duration"
    below: Annotated[float, Field(gt=0)] = 1.0
    """s₀, the duration from which on there is no penalty, by the scene's duration."""

    def add(self, inputs: PenaltyInputs) -> LossValue:
        require_moving(self.type, inputs)
        sums = inputs.sums(f"short_duration {self.below}")
        weight = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count)
        inputs.gaussians.device.program("motion_penalty.cl").short_duration(
            **inputs.arguments(MOTION), sums=sums, log_below=math.log(self.below), weight=weight
        )
        return LossValue("short_duration", lambda: weight * float(sums.get().sum(dtype="float64")))


def require_moving(name: str, inputs: PenaltyInputs) -> None:
    """Raise ConfigError where a penalty on the motion has none."""
    if not inputs.gaussians.moves:
        raise ConfigError(f"the loss '{name}': expected Gaussians that move; give `model.time`, or leave the loss out")
