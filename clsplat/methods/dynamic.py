"""Prune moving Gaussians that are invisible at all times."""

from typing import ClassVar, Literal

import numpy as np

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Positive
from clsplat.density.edit import Edit, Rule
from clsplat.formats.splats import MOTION, motion_fields, opacities
from clsplat.gaussians.motion import presence


class PruneInvisible(Rule):
    """Remove Gaussians that are almost transparent at every timestamp of the training views."""

    type: Literal["prune_invisible"] = "prune_invisible"
    grows: ClassVar[bool] = False
    training_keys: ClassVar[frozenset[str]] = frozenset({"opacity_below"})

    opacity_below: Positive = 0.005
    """Opacity below which a Gaussian is removed, at the timestamp nearest to its time center."""

    def mark(self, edit: Edit) -> None:
        gaussians = edit.gaussians
        if not gaussians.is_moving:
            raise ConfigError(f"'{self.type}' needs moving Gaussians; set `model.time`, or remove '{self.type}'")
        timestamps = np.unique([view.time or 0.0 for view in edit.survey.views])
        motion = gaussians.get(MOTION)
        centers = motion[:, motion_fields(motion.shape[1])["time_center"]][:, 0]
        upper = np.searchsorted(timestamps, centers).clip(1, max(len(timestamps) - 1, 1))
        presences = [presence(motion, timestamps[np.minimum(i, len(timestamps) - 1)]) for i in (upper - 1, upper)]
        opacity = opacities(gaussians.get("logit_opacity")[:, 0]) * np.maximum(*presences)
        edit.choose(opacity < edit.evaluate(self.opacity_below), copies=0, old_rows=0)
