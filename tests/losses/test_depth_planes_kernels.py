"""A plain wall that starts at the wrong depth, which only its points can correct."""

from dataclasses import replace

import numpy as np

from clsplat.conformance.scenes import random_case
from clsplat.density.statistics import SplatStats
from clsplat.losses.depth import InverseDepth
from clsplat.losses.image import L1
from clsplat.metrics.views import render_floats
from clsplat.photos.depths import PointDepths
from clsplat.photos.photographs import Photograph
from clsplat.render.camera import upload_camera
from clsplat.render.painter import SplatPainter
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.scene import Tracks
from clsplat.training.adam import Adam, Rates
from clsplat.training.modules.depth_supervision import DepthSupervisionState
from clsplat.training.trainer import StepTrainer
from tests.support.devices import on_one_setting

DEPTH, BEGUN, STEPS, NAMES = 4.0, 3.4, 160, ["0", "1", "2"]
RATES = Rates(means=8e-3, quats=0, log_scales=1e-3, logit_opacity=1e-2, sh_base=1e-2, sh_rest=0)


def error_after(device, weight: float) -> float:
    """The median error of the depths of the plain wall's Gaussians, scene units."""
    rng = np.random.default_rng(1)
    places = np.stack(np.meshgrid(np.linspace(-1.8, 1.8, 25), np.linspace(-1.2, 1.2, 17)), axis=-1).reshape(-1, 2)
    plain = np.abs(places[:, 0]) < 0.8
    case = replace(random_case(rng, len(places), 48, 36), degree=0)
    tables = case.parameters
    tables["means"][:] = np.column_stack([places, np.full(len(places), DEPTH)])
    tables["log_scales"][:], tables["logit_opacity"][:] = np.log(0.09), 2.0
    tables["sh_base"][plain] = 0.3
    model, rasterizer, black = case.model(device), Rasterizer(device, "radix"), device.zeros(3)
    photographs = []
    for number in range(len(NAMES)):
        pose = np.column_stack([np.eye(3), [0.3 * number - 0.3, 0, 0]]).astype(np.float32)
        camera = replace(upload_camera(device, replace(case.view, world_to_camera=pose)), view_index=number)
        values = np.clip(render_floats(SplatPainter(rasterizer, model, black), camera), 0, 1)
        pixels = np.ascontiguousarray(np.rint(255 * values).astype(np.uint8).transpose(2, 0, 1))
        photographs.append(Photograph(camera, device.upload(pixels)))
    points = tables["means"][plain].astype(np.float64)
    begun = tables["means"].copy()
    begun[plain] *= BEGUN / DEPTH
    model.gaussians.set("means", begun)
    parts = rasterizer, model, Adam(model.gaussians), SplatStats(model.gaussians), black
    trainer = StepTrainer(*parts, [L1(weight=0.8), InverseDepth(weight=weight)], RATES)
    tracks = Tracks(points, {name: np.arange(len(points)) for name in NAMES})
    trainer.modules = [DepthSupervisionState(PointDepths(device, tracks, NAMES, 2.0))]
    for step in range(1, STEPS + 1):
        trainer.step(photographs[step % len(NAMES)], step)
    return float(np.median(np.abs(model.gaussians.get("means")[plain, 2] - DEPTH)))


@on_one_setting
def test_points_halve_the_error_of_a_plain_wall(device):
    without, actual = (error_after(device, weight) for weight in (0.0, 1.0))
    print(without, actual)
    assert without > 0.5 * (DEPTH - BEGUN), "colors alone do not tell it"
    assert actual < 0.5 * without
