"""Split moving Gaussians in time, prune the invisible ones, and penalize their motion."""

import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Positive, at_step
from clsplat.density.edit import Edit, Rule
from clsplat.formats.splats import MOTION, motion_fields, opacities
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.motion import presence, shift_time_center
from clsplat.losses.base import LossValue, Penalty, PenaltyInputs
from clsplat.methods.adc import Grow

OFFSET = 0.6  # time from the center to each child, in durations
SHORTENING = 0.8  # child's duration by its parent's: 0.6² + 0.8² = 1 keeps the variance of both children together
MAX_DURATION = 0.5  # used for Gaussians that are always visible: half of the scene's duration
MAX_OPACITY = 1 - 1e-6


class SplitInTime(Grow):
    """Split Gaussians in time if their statistic is large and they travel farther than their size (ours).

    Two successive Gaussians, each with its own velocity, can follow a curve or a change of color.  At the time of their
    parent, both together are as opaque as the parent.
    """

    type: Literal["split_in_time"] = "split_in_time"
    training_keys: ClassVar[frozenset[str]] = frozenset({"travel_above", "duration_above"})

    travel_above: Positive = 1.0
    """Smallest distance traveled during the duration, divided by the Gaussian's largest standard deviation."""
    duration_above: Annotated[float, Field(gt=0)] = 0.1
    """Smallest duration of a Gaussian that is split, as a fraction of the scene's duration."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        require_motion(self.type, gaussians)
        is_large = edit.stats.mean(self.statistic) >= self.condition(edit)["gradient_above"]
        rows = np.flatnonzero(is_large & (edit.rows() == 1))
        names = ("means", "quats", "log_scales", "logit_opacity", MOTION)
        tables = {name: gaussians.get(name)[rows].astype(np.float64) for name in names}
        fields = motion_fields(tables[MOTION].shape[1])
        duration = np.minimum(np.exp(np.minimum(tables[MOTION][:, fields["log_duration"]][:, 0], 0)), MAX_DURATION)
        travel = np.linalg.norm(tables[MOTION][:, fields["velocity"]], axis=1) * duration
        size = np.exp(tables["log_scales"]).max(axis=1)
        is_split = (travel > edit.at(self.travel_above) * size) & (duration > self.duration_above)
        rows, duration = rows[is_split], duration[is_split]
        if not len(rows):
            return
        tables = {name: table[is_split] for name, table in tables.items()}
        children = [shift_time_center(tables, sign * OFFSET * duration) for sign in (-1, 1)]
        for child in children:
            child[MOTION][:, fields["log_duration"]] = np.log(SHORTENING * duration)[:, None]
            child["logit_opacity"] = divide_logits_in_time(tables["logit_opacity"])
        chosen = np.zeros(gaussians.count, bool)
        chosen[rows] = True
        edit.choose(chosen, copies=2, kept=0)
        for name in ("means", "quats", "logit_opacity", MOTION):
            edit.set_children(name, rows, np.stack([child[name] for child in children], axis=1))


class PruneInvisible(Rule):
    """Remove Gaussians that are almost transparent at every timestamp of the training views."""

    type: Literal["prune_invisible"] = "prune_invisible"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"opacity_below"})

    opacity_below: Positive = 0.005
    """Opacity below which a Gaussian is removed, at the timestamp nearest to its time center."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        require_motion(self.type, gaussians)
        timestamps = np.unique([view.time or 0.0 for view in edit.survey.views])
        motion = gaussians.get(MOTION)
        centers = motion[:, motion_fields(motion.shape[1])["time_center"]][:, 0]
        after = np.searchsorted(timestamps, centers).clip(1, max(len(timestamps) - 1, 1))
        near = [presence(motion, timestamps[np.minimum(i, len(timestamps) - 1)]) for i in (after - 1, after)]
        opacity = opacities(gaussians.get("logit_opacity")[:, 0]) * np.maximum(*near)
        edit.choose(opacity < edit.at(self.opacity_below), copies=0, kept=0)


def divide_logits_in_time(logit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logits of two children that together are as opaque as their parent at its time center."""
    opacity = (1 - np.sqrt(1 - np.minimum(opacities(logit), MAX_OPACITY))) / np.exp(-0.5 * (OFFSET / SHORTENING) ** 2)
    opacity = np.clip(opacity, 1 - MAX_OPACITY, MAX_OPACITY)
    return np.asarray(np.log(opacity / (1 - opacity)))


def require_motion(name: str, gaussians: Gaussians) -> None:
    """Raise ConfigError if the Gaussians do not move.  name: name of the rule or loss."""
    if not gaussians.is_moving:
        raise ConfigError(f"'{name}' needs Gaussians that move; set `model.time`, or remove '{name}'")


class MotionL2(Penalty):
    """Mean over Gaussians of min(s, 1) |v|, in extents: the distance traveled during the duration s (ours).

    For velocities that the images hardly determine.  On the synthetic scene it cost 0.3 to 0.5 dB together with
    `short_duration` (docs/results/moving.md), and no recipe uses it.
    """

    type: Literal["motion_l2"] = "motion_l2"

    def add(self, inputs: PenaltyInputs) -> LossValue:
        require_motion(self.type, inputs.gaussians)
        sums = inputs.sums("motion_l2")
        weight = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count) / inputs.extent
        inputs.gaussians.device.program("motion_penalty.cl").motion_l2(
            **inputs.arguments(MOTION), sums=sums, weight=weight
        )
        return LossValue("motion_l2", lambda: weight * float(sums.get().sum(dtype="float64")))


class ShortDuration(Penalty):
    """Mean over Gaussians of max(log(s₀ / s), 0) with s₀ = `below`, against durations of a single frame (ours).

    No recipe uses it: see `motion_l2`.
    """

    type: Literal["short_duration"] = "short_duration"
    below: Annotated[float, Field(gt=0)] = 1.0
    """s₀, the shortest duration without a penalty, as a fraction of the scene's duration."""

    def add(self, inputs: PenaltyInputs) -> LossValue:
        require_motion(self.type, inputs.gaussians)
        sums = inputs.sums(f"short_duration {self.below}")
        weight = at_step(self.weight, inputs.step) / max(1, inputs.gaussians.count)
        inputs.gaussians.device.program("motion_penalty.cl").short_duration(
            **inputs.arguments(MOTION), sums=sums, log_below=math.log(self.below), weight=weight
        )
        return LossValue("short_duration", lambda: weight * float(sums.get().sum(dtype="float64")))
