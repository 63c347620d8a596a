"""Jittered cameras and wrong focal lengths are recovered from photographs of a known model."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.conformance.scenes import random_case
from clsplat.core.schedule import Decay
from clsplat.density.statistics import SplatStats
from clsplat.losses.image import L1, Dssim
from clsplat.metrics.views import render_floats
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photograph
from clsplat.render.camera import upload_camera
from clsplat.render.painter import SplatPainter
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.view import View
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.camera_optimizer import DEPTHS, CameraOptimizer, CameraState, PoseChange
from clsplat.training.trainer import StepTrainer

VIEWS, STEPS, ANGLE, DEPTH = 6, 300, np.radians(0.3), 3.0
STILL = Rates(means=0, quats=0, log_scales=0, logit_opacity=0, sh_base=0, sh_rest=0)  # cameras alone are unknown


def errors(truth: list[View], actual: list[np.ndarray]) -> tuple[float, float]:
    """The largest angle in rad, and the largest distance of centers."""
    angles = [
        Rotation.from_matrix(pose[:, :3] @ view.world_to_camera[:, :3].T).magnitude()
        for view, pose in zip(truth, actual, strict=True)
    ]
    centers = [-pose[:, :3].T @ pose[:, 3] - view.position for view, pose in zip(truth, actual, strict=True)]
    return max(angles), float(np.linalg.norm(centers, axis=1).max())


def pose_errors(
    rng: np.random.Generator, info, jitter: float, zoom: float = 1.0
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Errors of cameras before and after they are learned, and of the focal length after it as a factor.

    jitter: 1 for 0.3 degrees and 0.3 % of the depth; zoom: of the given focal length.
    """
    case, device = random_case(rng, 200, 96, 72), Device(info)
    model, rasterizer = case.model(device), Rasterizer(device)
    background, photographs = device.upload(np.full(3, 0.3, np.float32)), list[Photograph]()
    places = [np.array([0.25 * number - 0.6, 0.15 * (number % 3), 0]) for number in range(VIEWS)]
    truth = [
        replace(
            case.view,
            name=str(n),
            world_to_camera=PoseChange(np.zeros(3), place, 0).apply_to(case.view.world_to_camera),
        )
        for n, place in enumerate(places)
    ]
    turns, shifts = jitter * rng.normal(size=(2, VIEWS, 3)) * np.array([[[ANGLE]], [[0.003 * DEPTH]]])
    turns, shifts = turns - turns.mean(axis=0), shifts - shifts.mean(axis=0)
    views = [
        replace(
            view,
            world_to_camera=PoseChange(turn, shift, 0).apply_to(view.world_to_camera),
            camera=view.camera.zoomed(zoom),
        )
        for view, turn, shift in zip(truth, turns, shifts, strict=True)
    ]
    for number, (view, given) in enumerate(zip(truth, views, strict=True)):
        values = np.clip(render_floats(SplatPainter(rasterizer, model, background), upload_camera(device, view)), 0, 1)
        pixels = np.ascontiguousarray(np.rint(255 * values).astype(np.uint8).transpose(2, 0, 1))
        photographs.append(Photograph(replace(upload_camera(device, given), view_index=number), device.upload(pixels)))
    rate = Decay(initial=2e-3, final=2e-5, over=STEPS)
    settings = CameraOptimizer(start=0, rotation=rate, translation=rate, focal="auto")
    poses = CameraState(settings, views, views)
    poses.rates = *settings.rates(STEPS, VIEWS), settings.focal_rate(STEPS, 1)
    for table in poses.pose_tables:
        table.begin(poses.scalars, {})
    poses.scalars |= {f"{DEPTHS}/{view.name}": DEPTH for view in views}
    parts = rasterizer, model, Adam(model.gaussians), SplatStats(model.gaussians, []), background
    trainer = StepTrainer(*parts, (L1(weight=0.8), Dssim(weight=0.2)), STILL, modules=[poses])
    for step in range(1, STEPS + 1):
        trainer.step(photographs[step % VIEWS], step)
    given = [view.world_to_camera for view in views]
    actual = [poses.pose(number) for number in range(VIEWS)]
    return errors(truth, given), errors(truth, actual), zoom * poses.factor(views[-1].name)


def test_exact_cameras_do_not_drift(rng, info):
    before, after, factor = pose_errors(rng, info, 0.0)
    print(np.degrees(after[0]), after[1], factor)
    assert before[0] < 1e-9
    assert np.degrees(after[0]) < 0.02
    assert after[1] < 0.001 * DEPTH
    assert factor == pytest.approx(1, abs=1e-4)


def test_a_wrong_focal_length_is_found_again_beside_poses(rng, info):
    before, after, factor = pose_errors(rng, info, 1.0, 0.98)
    print(factor, np.degrees(after[0]), after[1])
    assert np.degrees(before[0]) > 0.4
    assert factor == pytest.approx(1, abs=0.001)
    assert after[0] < before[0] / 5
    assert after[1] < before[1] / 5
