"""Timed cases: whole steps with all that a pipeline names, which change nothing."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.bench.cases import Case, run_bench
from clsplat.bench.peaks import Peaks
from clsplat.bench.scenes import case, synthetic
from clsplat.formats.motion import MOTION
from clsplat.gaussians.tables import INTERVAL2, PARAMETERS
from clsplat.pipeline.loading import load
from clsplat.render.camera import upload_camera
from clsplat.views.photographs import Photograph

SIZE = (64, 48, 300)  # width, height, Gaussians


@pytest.mark.parametrize(
    ("pipeline", "losses", "columns"),
    [
        ("smoke", ["l1", "dssim"], {"screen_grad"}),
        ("absgs", ["l1", "dssim"], {"screen_grad", "screen_grad_abs"}),
        (
            "micro_splatting_v2",
            ["l1", "l2", "dssim", "covariance_trace"],
            {"screen_grad", "texture", "blend_weight", "screen_radius"},
        ),
    ],
)
def test_a_case_does_what_its_pipeline_names_and_changes_nothing(device, pipeline, losses, columns):
    timed = case(device, *SIZE, load(pipeline).settings)
    trainer = timed.trainer
    assert (INTERVAL2 in trainer.model.gaussians.tables) == (pipeline == "micro_splatting_v2")
    assert trainer.adam.updates["sh_rest"] > 0, "harmonics are updated, so that their update is timed"
    before = {name: trainer.model.gaussians.get(name) for name in PARAMETERS}
    timed.step(record=True)
    view = trainer.step(timed.photograph, 1)
    assert sorted(loss.name for loss in view.losses) == sorted(losses)
    assert np.isfinite(view.loss)
    assert set(trainer.stats.names) == columns
    result = run_bench({"one": timed}, Peaks(100.0, 10.0, 10.0), repeats=2)["one"]
    for name in PARAMETERS:
        np.testing.assert_allclose(trainer.model.gaussians.get(name), before[name], rtol=0, atol=1e-20, err_msg=name)
    assert result.work.gaussians == SIZE[2]
    assert result.work.pairs > SIZE[2]
    assert set(result.floors) <= set(result.stages)
    assert "other" not in result.stages
    assert 0 < result.memory < 2 * result.planned


def test_a_case_that_moves_changes_nothing(device, rng):
    parameters, view = synthetic(*SIZE)
    parameters[MOTION] = rng.normal(0, 0.3, (SIZE[2], 5)).astype(np.float32)
    pixels = rng.integers(0, 256, (3, SIZE[1], SIZE[0]), dtype=np.uint8)
    photograph = Photograph(upload_camera(device, replace(view, time=0.5)), device.upload(pixels))
    timed = Case(device, parameters, photograph, "black", load("dynamic_7k").settings)
    np.testing.assert_allclose(timed.trainer.model.gaussians.get(MOTION), parameters[MOTION], rtol=0, atol=1e-20)


def test_a_case_starts_without_edits_due_and_is_timed_after_a_warm_up(device):
    timed = case(device, *SIZE, load("smoke").settings)
    assert not timed.clock
    assert not timed.stages
    timed.step(record=True)
    assert len(timed.clock) == 1
    assert all(len(times) == 1 for times in timed.stages.values())
