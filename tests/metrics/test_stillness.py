"""Flicker and the PSNR of static pixels against float64 NumPy on whole stacks."""

import cv2
import numpy as np
import pytest

from clsplat.metrics.views import (
    HELD_OUT_PSNR,
    MAX_NOISE,
    OTHER_PSNR,
    FlickerMeter,
    ViewMetrics,
    mean,
    means,
    psnr_by_time,
)
from clsplat.scene.camera import Camera
from clsplat.scene.view import View

MOMENTS, HEIGHT, WIDTH = 7, 6, 9
CAMERA = Camera(WIDTH, HEIGHT, 10.0, 10.0, 4.5, 3.0)


def pose(x=0.0):
    return np.column_stack([np.eye(3), [x, 0, 0]])


def moment(name, time, **values):
    return View(name, CAMERA, pose(values.pop("x", 0.0)), time=time, **values)


@pytest.fixture
def static(tmp_path):
    """Its left four columns are static."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :4] = 255
    cv2.imwrite(str(tmp_path / "static.png"), mask)
    return tmp_path / "static.png"


def stacks(rng):
    return rng.integers(0, 256, (2, MOMENTS, HEIGHT, WIDTH, 3), np.uint8)


def gathered(views, renders, photographs, counted=None):
    result = FlickerMeter(views)
    rows = [result.add(*item, counted) for item in zip(views, renders, photographs, strict=True)]
    return rows, result.flicker()


def test_flicker_is_the_deviation_over_time_of_one_camera(rng, static):
    renders, photographs = stacks(rng)
    views = [moment(f"{i}", i / (MOMENTS - 1), static_path=static) for i in range(MOMENTS)]
    rows, figures = gathered(views, renders, photographs)
    assert set(figures) == {view.name for view in views}
    expected = [float(item[:, :, :4].astype(np.float64).std(axis=0).mean()) for item in (renders, photographs)]
    assert [figures["3"][key] for key in ("flicker", "flicker_photographs")] == pytest.approx(expected, rel=1e-12)
    assert figures["3"]["static_share"] == pytest.approx(4 / 9)
    error = ((renders[:, :, :4].astype(np.float64) - photographs[:, :, :4]) ** 2).mean(axis=(1, 2, 3))
    assert [row["psnr_static"] for row in rows] == pytest.approx(10 * np.log10(255**2 / error), rel=1e-12)


def test_order_of_times_and_other_cameras_do_not_matter(rng, static):
    renders, photographs = stacks(rng)
    views = [moment(f"{i}", i / (MOMENTS - 1), static_path=static) for i in range(MOMENTS)]
    other = [moment(f"o{i}", i / (MOMENTS - 1), x=1.0, static_path=static) for i in range(MOMENTS)]
    order = rng.permutation(MOMENTS)
    _, figures = gathered(views, renders, photographs)
    mixed = [item for i in order for item in (views[i], other[i])]
    _, again = gathered(mixed, np.repeat(renders[order], 2, axis=0), np.repeat(photographs[order], 2, axis=0))
    assert {name: again[name] for name in figures} == figures


def test_static_mask_defaults_to_unchanged_pixels(rng):
    renders, photographs = stacks(rng)
    photographs[:] = photographs[0]
    photographs[2, :, 5:] ^= 128  # something passes
    photographs[1, 0, 0] ^= 3  # noise
    views = [moment(f"{i}", i / (MOMENTS - 1)) for i in range(MOMENTS)]
    rows, figures = gathered(views, renders, photographs)
    still = photographs.astype(np.float64).std(axis=0).max(axis=2) <= MAX_NOISE
    assert still[:, :5].all()
    assert not still[:, 5:].any()
    assert figures["0"]["flicker"] == pytest.approx(renders[:, still].astype(np.float64).std(axis=0).mean())
    assert rows == [{}] * MOMENTS, "no file says which pixels are static"


def test_masked_pixels_do_not_count(rng, static):
    renders, photographs = stacks(rng)
    counted = np.ones((HEIGHT, WIDTH), bool)
    counted[:3] = False
    views = [moment(f"{i}", i / (MOMENTS - 1), static_path=static) for i in range(MOMENTS)]
    _, figures = gathered(views, renders, photographs, counted)
    assert figures["0"]["flicker"] == pytest.approx(renders[:, 3:, :4].astype(np.float64).std(axis=0).mean())


def test_static_scene_has_no_stillness_metrics(rng):
    renders, photographs = stacks(rng)
    assert gathered([moment("a", None)], renders[:1], photographs[:1]) == ([{}], {})
    assert gathered([moment("a", 0.5)], renders[:1], photographs[:1]) == ([{}], {}), "one moment"


def test_camera_with_one_time_needs_no_row_and_no_memory(rng, static):
    renders, photographs = stacks(rng)
    moving = [moment(f"m{i}", i / 19, x=1.0 + i, static_path=static) for i in range(20)]
    assert FlickerMeter(moving).camera_count == 0
    fixed = [moment(f"{i}", i / (MOMENTS - 1), static_path=static) for i in range(MOMENTS)]
    places = [moment(f"p{i}{k}", k / 2, x=-1.0 - i) for i in range(9) for k in range(2)]
    assert FlickerMeter([*places, *fixed]).camera_count == 8
    _, figures = gathered([*moving[:MOMENTS], *fixed], [*renders, *renders], [*photographs, *photographs])
    assert figures == gathered(fixed, renders, photographs)[1] != {}


def test_held_out_times_are_measured_separately():
    views = [moment(f"{i}", time) for i, time in enumerate((0, 0.5, 1))]
    psnr = {view.name: 20.0 + i for i, view in enumerate(views)}
    moments = psnr_by_time(psnr, views, [views[0], views[2]])
    assert moments == {"0": {OTHER_PSNR: 20.0}, "1": {HELD_OUT_PSNR: 21.0}, "2": {OTHER_PSNR: 22.0}}
    result = mean([ViewMetrics(name, value, 0.9, by_time=moments[name]) for name, value in psnr.items()])
    assert (result["psnr"], result[HELD_OUT_PSNR], result[OTHER_PSNR]) == (21, 21, 21)
    for trained in (views, [moment("x", 0.2)], [moment("y", None)], []):
        assert not psnr_by_time(psnr, views, trained)


def test_means_are_over_views_with_the_metric():
    assert means([{"a": 1.0}, {"a": 3.0, "b": 5.0}, {}]) == {"a": 2.0, "b": 5.0}
