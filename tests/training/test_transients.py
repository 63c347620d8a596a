"""Pixels that are masked because they show transient objects."""

import numpy as np
import pytest

from clsplat.training import checkpoint
from clsplat.training.modules.transients import BINS, KEYS, Transients, mask_transients, measure_residuals
from tests.support.runs import FEW, digest, train

ON = (*FEW, "optimize.modules.transients={start: 4, outlier_ratio: 1, tail_ratio: 0}")


def distribution(**scalars: float) -> dict[str, float]:
    """Numbers of residuals by bin."""
    return {KEYS[int(name[1:])]: number for name, number in scalars.items()}


def test_threshold_is_the_upper_edge_of_a_bin():
    settings = Transients(start=10, quantile=0.9, outlier_ratio=1, tail_ratio=0)
    scalars = distribution(_40=50, _60=40, _80=10)
    assert settings.threshold(scalars, 10) is None, "not yet"
    assert settings.threshold({}, 11) is None
    assert settings.threshold(scalars, 11) == 2.0**-12 * 2**7 * (1 + 5 / 8), "bin 61 begins there"
    assert settings.model_copy(update={"outlier_ratio": 2}).threshold(scalars, 11) == 2 * settings.threshold(
        scalars, 11
    )
    assert settings.model_copy(update={"quantile": 0.5}).threshold(scalars, 11) == 2.0**-12 * 2**5 * (1 + 1 / 8)


def test_all_pixels_count_without_outliers():
    """Eight bins are an octave: 24 of them a factor of eight."""
    settings = Transients(start=0, tail_ratio=8)
    assert settings.threshold(distribution(_40=90, _64=10), 1) is None
    assert settings.threshold(distribution(_40=90, _65=10), 1) is not None
    assert settings.threshold(distribution(_40=995, _65=5), 1) is None, "beyond the 99 % quantile"


def test_distribution_fades():
    settings, scalars = Transients(start=0, decay=0.5), {}
    for _ in range(2):
        settings.update_histogram(scalars, np.eye(BINS, dtype=np.uint32)[3] * 8)
    assert scalars == {key: 12.0 if key == KEYS[3] else 0.0 for key in KEYS}


@pytest.mark.slow
def test_run_learns_the_distribution_of_residuals(tiny_scene, tmp_path, few_steps):
    run = train(tiny_scene, tmp_path / "run", *ON)
    assert sum(run.modules["transients"].scalars[key] for key in KEYS) > 40 * 40
    assert digest(tmp_path / "run") != digest(few_steps)
    state, _ = checkpoint.load(checkpoint.list_files(tmp_path / "run")[-1])
    assert state.modules["transients"] == run.modules["transients"].scalars


@pytest.mark.slow
def test_transients_change_no_bits_without_masked_pixels(tiny_scene, tmp_path, few_steps):
    train(tiny_scene, tmp_path / "run", *FEW, "optimize.modules.transients={start: 4, tail_ratio: 1e9}")
    assert digest(tmp_path / "run") == digest(few_steps)


@pytest.mark.slow
def test_object_in_one_image_is_masked_there(tiny_scene, tmp_path):
    """And little else, of a model that has begun to look like the scene."""
    run = train(
        tiny_scene,
        tmp_path / "run",
        "optimize.steps=150",
        "densify.stop=100",
        "optimize.modules.transients={start: 150}",
    )
    photograph = run.photographs.get(run.scene.split("train")[3])
    pixels = photograph.colors.get()
    pixels[:, 12:24, 10:22] = np.array([255, 0, 255])[:, None, None]
    photograph.colors.set(pixels)
    workspace, planes = run.rasterizer.workspace, photograph.planes(run.rasterizer.workspace)
    image = run.rasterizer.forward(run.model, photograph.camera, run.photographs.background).image
    residuals, _ = measure_residuals(workspace, photograph.camera, image, planes.colors, None)
    settings = Transients(start=150, tail_ratio=0)
    threshold = settings.threshold(run.modules["transients"].scalars, 151)
    assert threshold is not None
    reach = max(1, round(settings.box_size * 40 / 2))
    left_out = mask_transients(workspace, photograph.camera, residuals, threshold, reach).get()[0, :40, :40] == 0
    inside = left_out[12:24, 10:22].copy()
    left_out[11:25, 9:23] = False
    assert (inside.mean() > 0.8, left_out.mean() < 0.05) == (True, True), (inside.mean(), left_out.mean())
