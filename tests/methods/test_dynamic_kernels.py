"""Rules that split Gaussians in time and prune Gaussians that no view shows."""

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
from clsplat.formats.splats import MOTION, PARAMETERS, motion_width
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.model import Model
from clsplat.gaussians.motion import presence
from clsplat.methods.dynamic import PruneInvisible, SplitInTime
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
def test_far_moving_gaussian_splits_along_its_path(device, rng):
    case = moving_case(rng, 65, WIDTH)
    case.parameters[MOTION][:, :3] *= 5
    case.parameters["log_scales"][:] = np.log(0.2)
    gaussians, gradients = case.model(device).gaussians, rng.choice([1e-4, 5e-4], 65)
    before = Model(**{name: gaussians.get(name) for name in (*PARAMETERS, MOTION)})
    duration = np.minimum(np.exp(np.minimum(before.motion[:, 4].astype(np.float64), 0)), 0.5)
    far = np.linalg.norm(before.motion[:, :3], axis=1) * duration > 0.2
    chosen = np.flatnonzero((gradients > 2e-4) & far & (duration > 0.1))
    assert 5 < len(chosen) < 50
    edit = Edit(gaussians, statistics_of(gaussians, gradients), SceneScale(2.0), step=700, seed=4)
    densify(edit, [SplitInTime()], Rasterizer(device, "radix").tiler)
    assert gaussians.count == 65 + len(chosen)
    after = Model(**{name: gaussians.get(name) for name in (*PARAMETERS, MOTION)})
    rows = np.repeat(np.arange(65), np.isin(np.arange(65), chosen) + 1)
    early, late = (np.array([np.flatnonzero(rows == n)[i] for n in chosen]) for i in (0, 1))
    for time in (0.2, 0.7):
        for children in (early, late):
            np.testing.assert_allclose(_places(after, time)[children], _places(before, time)[chosen], atol=1e-4)
    np.testing.assert_allclose(after.motion[early, 3] + after.motion[late, 3], 2 * before.motion[chosen, 3], atol=1e-5)
    np.testing.assert_allclose(np.exp(after.motion[early, 4]), 0.8 * duration[chosen], rtol=1e-5)
    at_center = [
        after.opacities[children] * presence(_since(after.motion[children], before.motion[chosen, 3]), 0)
        for children in (early, late)
    ]
    together = 1 - (1 - at_center[0]) * (1 - at_center[1])
    capped = after.opacities[early] > 0.999
    np.testing.assert_allclose(together[~capped], before.opacities[chosen][~capped], rtol=1e-3)


def _places(model: Model, time: float) -> np.ndarray:
    m = model.motion.astype(np.float64)
    dt = time - m[:, 3:4]
    means = model.means + m[:, :3] * dt + m[:, 5:8] * dt**2 + m[:, 8:11] * dt**3
    return np.hstack([means, model.quats + m[:, 11:] * dt])


def _since(motion: np.ndarray, times: np.ndarray) -> np.ndarray:
    shifted = motion.astype(np.float64)
    shifted[:, 3] -= times
    return shifted


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
@pytest.mark.parametrize("rule", [SplitInTime(), PruneInvisible()])
def test_motion_rules_need_motion(device, rng, rule):
    gaussians = random_case(rng, 17).model(device).gaussians
    edit = Edit(gaussians, statistics_of(gaussians, np.zeros(17)), SceneScale(2.0), step=700, seed=4)
    with pytest.raises(ConfigError, match=r"model\.time"):
        rule.mark(edit)
