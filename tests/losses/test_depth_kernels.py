"""The blended inverse depth, its gradient, and its loss, against float64."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.check import relative_error
from clsplat.conformance.checks.blending import check_depth, differentiate, inverse_depths, losses_of_depths
from clsplat.conformance.scenes import random_case, safe_case
from clsplat.losses.depth import InverseDepth
from clsplat.losses.image import L1
from clsplat.opencl.device import Device
from clsplat.photos.depths import PointDepths, nearest_in_pixels
from clsplat.scene.scene import Tracks
from clsplat.stages.optimize import Optimize
from clsplat.training.modules.depth_supervision import DepthSupervisionState
from tests.support.deviations import assert_schedules_agree, assert_within_bounds
from tests.support.device_images import trainer_of
from tests.support.devices import on_one_setting


def test_plane_and_gradients(device, rng):
    assert_within_bounds(inverse_depths(device, rng))


def test_loss_and_gradient(device, rng):
    assert_within_bounds(losses_of_depths(device, rng))


def test_pixel_box_filter(device, rng):
    case = replace(safe_case(rng, 40, 33, 30, 1e-5, variance=0.0, pixel_box=1.0))
    assert_within_bounds(check_depth(device, case, rng.normal(size=(4, 30, 33)).astype(np.float32), "the pixel's box"))


@on_one_setting
def test_schedules_agree(device, rng):
    case, weights = random_case(rng, 150, 50, 70), rng.normal(size=(4, 70, 50)).astype(np.float32)
    other = Device(device.info, "simt" if device.schedule == "wide" else "wide")
    for number, (one, two) in enumerate(zip(*(differentiate(d, case, weights) for d in (device, other)), strict=True)):
        assert relative_error(two, one) < 1e-5
        if number == 0:
            assert_schedules_agree(device, two, one)


def test_reference_gradient_matches_finite_differences(rng):
    """By parameters, so that depths move too."""
    case = random_case(rng, 5, 24, 20)
    gaussians, camera, weights = case.gaussians(), case.camera(), rng.normal(size=(20, 24))
    numbers = {**case.projection_settings(), "thresholds": ref.SMOOTH_THRESHOLDS}

    def loss(moved: ref.RawGaussians) -> float:
        splats = ref.project(moved, camera, case.degree, **numbers)
        return float((weights * ref.inverse_depth(splats, 24, 20, ref.SMOOTH_THRESHOLDS)).sum())

    splats = ref.project(gaussians, camera, case.degree, **numbers)
    actual, grad_depth = ref.inverse_depth_backward(splats, 24, 20, weights, ref.SMOOTH_THRESHOLDS)
    upstream = actual.mean2d, actual.conic, actual.opacity, actual.color
    settings = case.degree, case.variance, case.compensate
    gradients = ref.project_backward(gaussians, camera, *settings, splats, *upstream)
    gradients["means"] = gradients["means"] + grad_depth[:, None] * camera.rotation[2]
    free = splats.opacity < 0.98
    for name in ("means", "quats", "log_scales", "logit_opacity"):
        values = gradients[name]
        for place in np.ndindex(values.shape):
            if not free[place[0]]:
                continue
            ends = []
            for step in (1e-5, -1e-5):
                table = getattr(gaussians, name).copy()
                table[place] += step
                ends.append(loss(replace(gaussians, **{name: table})))
            difference = (ends[0] - ends[1]) / 2e-5
            assert difference == pytest.approx(values[place], rel=1e-4, abs=1e-6 * np.abs(values).max())


def test_loss_gradient_matches_finite_differences(rng):
    plane, targets, weights = rng.uniform(size=(6, 7)), rng.uniform(size=9), rng.uniform(size=9)
    places = np.unravel_index(rng.permutation(42)[:9], plane.shape)
    _, gradient = ref.inverse_depth_loss(plane, places, targets, weights)
    for place in np.ndindex(plane.shape):
        ends = []
        for step in (1e-7, -1e-7):
            moved = plane.copy()
            moved[place] += step
            ends.append(ref.inverse_depth_loss(moved, places, targets, weights)[0].sum())
        assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(gradient[place], abs=1e-6)


def test_nearest_point_per_pixel_counts_and_outside_none(device, rng):
    camera = random_case(rng, 1, 40, 30).device_camera(device)
    pose = camera.values["world_to_camera"].reshape(3, 4).astype(np.float64)
    fx, fy, cx, cy = (float(camera.values[name]) for name in ("fx", "fy", "cx", "cy"))

    def at(column: float, row: float, depth: float) -> np.ndarray:
        point = np.array([(column - cx) / fx * depth, (row - cy) / fy * depth, depth])
        return pose[:, :3].T @ (point - pose[:, 3])

    positions = [at(7.2, 3.9, 4), at(7.8, 3.1, 2), at(7.2, 3.2, 3), at(39.9, 29.9, 5), at(40.1, 3, 2), at(5, 5, -2)]
    places, depths, rows = nearest_in_pixels(camera, np.stack(positions))
    assert rows.tolist() == [1, 3]
    assert places.tolist() == [3 * camera.stride + 7, 29 * camera.stride + 39]
    np.testing.assert_allclose(depths, [2, 5], rtol=1e-6)


def depths_of_means(device: Device, trainer, photograph, count: int = 30) -> PointDepths:
    """Depths at the means of the first Gaussians: a view with the number 0 shows all, another one half of them."""
    means = trainer.model.gaussians.get("means")[:count].astype(np.float64)
    tracks = Tracks(means, {"a": np.arange(count), "b": np.arange(count // 2), "c": np.arange(count // 2)})
    return PointDepths(device, tracks, ["a", "x"], 2.0)


@on_one_setting
def test_points_with_more_observations_weigh_more(device, rng):
    trainer, photograph = trainer_of(device, rng, [L1()])
    result = depths_of_means(device, trainer, photograph)
    camera = replace(photograph.camera, view_index=0)
    here = result.at(camera)
    assert here is not None
    assert here is result.at(camera), "kept"
    assert set(np.unique(here.weights.get())) == {0.25, 0.75}
    assert result.at(replace(camera, view_index=1)) is None, "a view without points"
    assert result.at(photograph.camera) is None, "a view that is not trained on"


@on_one_setting
def test_training_with_the_loss_approaches_known_depths(device, rng):
    """Of Gaussians that were moved along their rays; without weight the bits are those of a training without it."""
    values = []
    for weight in (0.0, 0.3):
        local = np.random.default_rng(3)
        trainer, photograph = trainer_of(device, local, [L1(weight=0.0), InverseDepth(weight=weight)])
        trainer.modules = [DepthSupervisionState(depths_of_means(device, trainer, photograph))]
        photograph = replace(photograph, camera=replace(photograph.camera, view_index=0), mask=None)
        measured = replace(trainer, losses=[L1(weight=0.0), InverseDepth(weight=1.0)])
        for step in range(1, 60):
            trainer.step(photograph, step)
        values.append(measured.compare(photograph, 60).losses[1].value())
    assert values[1] < 0.7 * values[0]


def test_training_also_needs_a_loss_on_colors():
    with pytest.raises(ValueError, match="at least one loss must compare images"):
        Optimize(steps=3, losses=[InverseDepth()])
