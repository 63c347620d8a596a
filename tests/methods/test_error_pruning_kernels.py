"""Pruning by the error that it causes in training views (error_pruning.py), against the reference."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.blending import MARGIN
from clsplat.conformance.scenes import Case, safe_case
from clsplat.density.edit import Edit
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey
from clsplat.density.thresholds import SceneScale
from clsplat.formats.splats import SH_C0
from clsplat.methods.error_pruning import PruneRedundant, find_largest_allowed, squared_error
from clsplat.methods.mini_splatting import sampled_weights
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photograph
from clsplat.render.rasterizer import Rasterizer
from tests.support.devices import on_devices, on_one_setting

BACKGROUND = np.array([0.25, 0.5, 0.125], np.float32)


def image_of(case: Case, rows: np.ndarray, exposure: float = 1.0) -> np.ndarray:
    """The reference's image of some of the Gaussians, [height, width, 3]."""
    part = replace(case, parameters={name: table[rows] for name, table in case.parameters.items()})
    background = exposure * BACKGROUND.astype(np.float64)
    return ref.render(part.gaussians(), part.camera(), background, part.degree, part.near).image.transpose(1, 2, 0)


def survey_of(device: Device, case: Case, photographs: list, masks: list, exposure: float = 1.0) -> Survey:
    camera = case.device_camera(device)
    held = []
    for colors, mask in zip(photographs, masks, strict=True):
        uploaded = None if mask is None else device.upload(mask[None].astype(np.uint8))
        held.append(Photograph(camera, device.upload(colors), uploaded))
    source = SimpleNamespace(get=lambda view: held[view], background=device.upload(np.float32(exposure) * BACKGROUND))
    return Survey(Rasterizer(device, "radix"), case.model(device), source, range(len(held)), 0, 0)


def photographs_like(rng, case: Case, count: int) -> list[np.ndarray]:
    """Images of all Gaussians with noise, [3, height, width], even 8-bit values."""
    image = image_of(case, np.arange(len(case.parameters["means"]))).transpose(2, 0, 1)
    noisy = [image + rng.normal(0, 0.05, image.shape) for _ in range(count)]
    return [(4 * np.round(np.clip(picture, 0, 1) * 60)).astype(np.uint8) for picture in noisy]


def error_of(case: Case, rows: np.ndarray, photographs: list, masks: list) -> float:
    image, total = image_of(case, rows), 0.0
    for colors, mask in zip(photographs, masks, strict=True):
        squares = (image - colors.transpose(1, 2, 0) / 255) ** 2
        total += squares[np.ones(squares.shape[:2], bool) if mask is None else mask].sum()
    return total


def pruned(survey: Survey, rule: PruneRedundant) -> np.ndarray:
    """The rows that a rule removes; nothing is changed before the edit is applied."""
    gaussians = survey._model.gaussians
    before = {name: gaussians.get(name) for name in gaussians.tables}
    edit = Edit(gaussians, SplatStats(gaussians), SceneScale(1.0), step=600, seed=3, survey=survey)
    edit.mark(copies=2, old_rows=1)
    rule.mark(edit)
    for name, table in before.items():
        np.testing.assert_array_equal(gaussians.get(name), table)
    return np.flatnonzero(edit.row_counts() == 0)


@on_devices("count, width, height", [(0, 16, 16), (1, 16, 16), (17, 33, 31), (40, 24, 24)])
def test_views_limit_the_number_of_pruned_gaussians(device, rng, count, width, height):
    """Those with the least weight; one more would raise the error of the reference's images above the limit."""
    case = safe_case(rng, count, width, height, MARGIN)
    masks = [None, rng.random((height, width)) < 0.7]
    photographs = photographs_like(rng, case, 2)
    survey = survey_of(device, case, photographs, masks)
    weight = sum(ref.contribution(case.project(), width, height, mask) for mask in masks)
    np.testing.assert_allclose(sampled_weights(survey).total, weight, rtol=1e-4, atol=1e-5)
    order = np.argsort(sampled_weights(survey).total, kind="stable")
    before = error_of(case, np.arange(count), photographs, masks)
    assert squared_error(survey, survey.views) == pytest.approx(before, rel=1e-3)
    for rise in (0.02, 0.3, 3.0):
        gone = pruned(survey, PruneRedundant(error_rise=rise))
        number = len(gone)
        assert set(gone) == set(order[:number])
        assert error_of(case, order[number:], photographs, masks) <= (1 + rise) * before * 1.002
        if number < count:
            assert error_of(case, order[number + 1 :], photographs, masks) >= (1 + rise) * before * 0.998


@on_one_setting
def test_half_the_exposure_gives_the_same_selection(device, rng):
    case = safe_case(rng, 40, 32, 24, MARGIN)
    photographs = photographs_like(rng, case, 2)
    dim = replace(case, parameters={name: table.copy() for name, table in case.parameters.items()})
    dim.parameters["sh_base"][:] = 0.5 * case.parameters["sh_base"] - 0.25 / SH_C0
    dim.parameters["sh_rest"][:] *= 0.5
    masks = [None, None]
    bright = pruned(survey_of(device, case, photographs, masks), PruneRedundant(error_rise=0.1))
    half = [colors // 2 for colors in photographs]
    assert 0 < len(bright) < 40
    np.testing.assert_array_equal(
        pruned(survey_of(device, dim, half, masks, 0.5), PruneRedundant(error_rise=0.1)), bright
    )


@on_one_setting
def test_zero_error_keeps_visible_gaussians(device, rng):
    """Where nothing may be lost, those without weight go and no others."""
    case = safe_case(rng, 20, 24, 24, MARGIN)
    case.parameters["means"][::4] -= 20 * case.view.world_to_camera[2, :3]  # behind the camera
    photographs = photographs_like(rng, case, 1)
    survey = survey_of(device, case, photographs, [None])
    unseen = np.flatnonzero(sampled_weights(survey).total == 0)
    assert 5 <= len(unseen) < 20
    assert set(unseen) <= set(pruned(survey, PruneRedundant(error_rise=1e-12)))


@pytest.mark.parametrize(("count", "limit"), [(0, 0), (1, 0), (1, 1), (7, 3), (255, 255), (1000, 600), (10**6, 123456)])
def test_pruned_number_is_accurate_to_one_part_in_256(count, limit):
    asked = []
    result = find_largest_allowed(lambda number: asked.append(number) or number <= limit, count)
    assert result <= limit
    assert limit - result < max(1, count // 256)
    assert len(asked) <= 10
