"""Whole runs with dropout, the regularization for few photographs."""

import numpy as np
import pytest

from clsplat.conformance.scenes import random_case
from clsplat.core.errors import ConfigError
from clsplat.density.statistics import SEEN, SplatStats
from clsplat.gaussians.gaussians import DropoutMask
from clsplat.losses.base import Comparison, ViewGradients
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import choose_device
from clsplat.pipeline.loading import load
from clsplat.render.rasterizer import Rasterizer
from tests.support.runs import digest, train

pytestmark = pytest.mark.slow

DROPOUT = "optimize.modules.dropout.probability=[[0, 0.0], [6, 0.4]]"
PIPELINE = """
name: sparse
stages:
  - init: {source: auto, opacity: 0.3, count: 60}
  - optimize:
      steps: 12
      losses: [l1]
      log_every: 5
      during:
        - densify: {every: 4, start: 3, rules: [{type: clone, gradient_above: 1.0e-9, size_below: 1}]}
        - checkpoint: {every: 4, keep: 9}
  - export: {file: point_cloud.ply}
"""


@pytest.fixture
def pipeline(tmp_path):
    (tmp_path / "sparse.yaml").write_text(PIPELINE)
    return str(tmp_path / "sparse.yaml")


def test_dropout_changes_the_bits(tiny_scene, tmp_path, pipeline):
    whole = digest(train(tiny_scene, tmp_path / "whole", DROPOUT, pipeline=pipeline).out)
    without = [
        digest(train(tiny_scene, tmp_path / n, *s, pipeline=pipeline).out)
        for n, s in (
            ("plain", ()),
            ("never", ("optimize.modules.dropout.probability=[[0, 0], [9, 0]]",)),
        )
    ]
    assert len(set(without)) == 1
    assert without[0] != whole


def test_dropped_gaussian_counts_as_invisible(rng):
    device = Device(choose_device())
    case = random_case(rng, 40)
    model, camera, rasterizer = case.model(device), case.device_camera(device), Rasterizer(device)
    model.dropout = DropoutMask(0.5, 1, 2)
    stats = SplatStats(model.gaussians, ("screen_grad",))
    frame = rasterizer.forward(model, camera, device.zeros(3))
    sums = device.upload(np.ones((rasterizer.pixel_sums(model, frame, frame.image)).shape, np.float32))
    comparison = Comparison(rasterizer.workspace, camera, frame.image, frame.image, frame.image)
    stats.add(ViewGradients(frame, comparison, [], sums), sums)
    drawn = frame.radius.get()[:40] > 0
    assert 5 < drawn.sum() < 35
    for column in (SEEN, "stats/screen_grad"):
        np.testing.assert_array_equal(model.gaussians.get(column)[:, 0] > 0, drawn)


@pytest.mark.parametrize("wrong", ["1", "-0.1", "[[0, 0.2], [9, 2]]"])
def test_probability_out_of_range_is_refused(pipeline, wrong):
    with pytest.raises(ConfigError, match=r"expected values (of at most 0\.9|at least 0)"):
        load(pipeline, [f"optimize.modules.dropout.probability={wrong}"])
