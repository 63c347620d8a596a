"""The rule that prunes Gaussians that no view shows at any time."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance.checks.motion import moving_case
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import ConfigError
from clsplat.density.control import densify
from clsplat.density.edit import Edit
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import MOTION, motion_width
from clsplat.gaussians.gaussians import Gaussians
from clsplat.methods.dynamic import PruneInvisible
from clsplat.photos.photographs import Photographs
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam
from tests.support.devices import on_one_setting

WIDTH = motion_width(3, True)


def statistics_of(gaussians: Gaussians, gradients: np.ndarray) -> SplatStats:
    Adam(gaussians)
    stats = SplatStats(gaussians)
    gaussians.set(SEEN, np.full((gaussians.count, 1), 2.0))
    gaussians.set("stats/screen_grad", 2 * gradients[:, None])
    return stats


@on_one_setting
def test_gaussians_invisible_at_all_times_are_pruned(device, rng):
    case = moving_case(rng, 65)
    motion = case.parameters[MOTION]
    motion[:, 3], motion[:, 4] = rng.uniform(0, 1, 65), -1
    motion[:10, 3], motion[:10, 4] = 0.5, np.log(0.02)  # between two moments
    motion[10:20, 3], motion[10:20, 4] = 2.5, -1  # after the last
    case.parameters["logit_opacity"][:] = 0
    model = case.model(device)
    views = [replace(case.view, time=time) for time in (0.0, 0.375, 0.625, 1.0)]
    survey = Survey(Rasterizer(device, "radix"), model, Photographs(device, "black"), views, 0, 700)
    edit = Edit(model.gaussians, statistics_of(model.gaussians, np.zeros(65)), SceneScale(2.0), 700, 4, survey)
    densify(edit, [PruneInvisible()], Rasterizer(device, "radix").tiler)
    assert model.gaussians.count == 45


@on_one_setting
def test_motion_rules_need_motion(device, rng):
    gaussians = random_case(rng, 17).model(device).gaussians
    edit = Edit(gaussians, statistics_of(gaussians, np.zeros(17)), SceneScale(2.0), step=700, seed=4)
    with pytest.raises(ConfigError, match=r"model\.time"):
        PruneInvisible().mark(edit)
