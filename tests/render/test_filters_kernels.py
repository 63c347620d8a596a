"""filter.cl against the reference, and the effect of both filters on image brightness."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.reference import sampling_interval
from clsplat.conformance.scenes import Case, random_case
from clsplat.core.errors import ConfigError
from clsplat.core.settings import Settings
from clsplat.gaussians.gaussians import DeviceModel, Gaussians
from clsplat.opencl.device import Device
from clsplat.render.camera import upload_camera
from clsplat.render.filters import Dilation, Ewa, FilterViews, Mip, NoWorldFilter, ScreenFilter, Smoothing
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.camera import Camera
from clsplat.scene.view import View
from tests.support.devices import each_once, on_devices, on_one_setting

COUNTS = (1, 15, 16, 17, 63, 64, 65, 200)


def views_around(case: Case, rng: np.random.Generator, count: int) -> list[View]:
    """Cameras of several focal lengths and image sizes that look at the scene from somewhere near the case's."""
    views = []
    for i in range(count):
        pose = np.array(case.view.world_to_camera, np.float32).astype(np.float64)
        pose[:, 3] += np.float32(rng.normal(0, 0.8, 3))
        scale = float(rng.choice([1, 2, 4]))
        camera = replace(case.view.camera.downscaled(scale), fx=float(rng.uniform(20, 60)) / scale)
        views.append(replace(case.view, name=f"view{i}", camera=camera, world_to_camera=pose, downscale=scale))
    return views


def oracle(view: View) -> ref.PinholeCamera:
    c = view.camera
    pose = np.float64(np.float32(view.world_to_camera))
    return ref.PinholeCamera(pose, *(float(np.float32(value)) for value in (c.fx, c.fy, c.cx, c.cy)), c.width, c.height)


def refreshed(device: Device, case: Case, views: list[View], settings: Smoothing) -> np.ndarray:
    gaussians = case.model(device).gaussians
    settings.refresh(gaussians, FilterViews(device, views), near=0.2)
    return gaussians.get("filter_variance")[:, 0]


@on_devices("count, focal", each_once(COUNTS, ["per_camera", "global_max"]))
def test_filter_variance(device, rng, count, focal):
    case = random_case(rng, count)
    case.parameters["means"][::3] *= 4  # out of sight of some, or of all
    views = views_around(case, rng, 7)
    lengths = [view.camera.fx for view in views]
    if focal == "global_max":
        lengths = [max(lengths)] * 7
    interval = sampling_interval(case.parameters["means"].astype(np.float64), [oracle(v) for v in views], lengths)
    variance = refreshed(device, case, views, Smoothing(variance=0.2, focal=focal))
    np.testing.assert_allclose(variance, 0.2 * interval**2, rtol=1e-5)


@on_one_setting
def test_shared_focal_length_makes_both_definitions_equal(device, rng):
    case = random_case(rng, 100)
    views = [replace(view, camera=replace(view.camera, fx=40.0)) for view in views_around(case, rng, 5)]
    of_each = refreshed(device, case, views, Smoothing())
    np.testing.assert_array_equal(refreshed(device, case, views, Smoothing(focal="global_max")), of_each)
    assert len(np.unique(of_each)) > 20


def test_invisible_gaussians_get_the_largest_variance(device, rng):
    case = random_case(rng, 40)
    means = case.parameters["means"]
    means[3] = -50 * case.view.world_to_camera[2, :3]  # behind the camera
    means[20] = np.nan
    variance = refreshed(device, case, [case.view], Smoothing())
    assert variance[3] == variance[20] == variance.max()
    means[:] = means[3]
    assert (refreshed(device, case, [case.view], Smoothing()) == 0).all(), "no Gaussian is seen"


@on_one_setting
def test_nothing_to_filter(device, rng):
    case = random_case(rng, 0)
    assert refreshed(device, case, [case.view], Smoothing()).shape == (0,)
    gaussians = random_case(rng, 5).model(device).gaussians
    NoWorldFilter().refresh(gaussians, FilterViews(device, [case.view]), near=0.2)
    assert (gaussians.get("filter_variance") == 0).all()


def grid_of_specks(device: Device, screen: Dilation | Ewa | Mip, scale: int) -> float:
    """Brightness of an image at 1/scale, per area of the full one, of 17 x 17 faint discs of 0.5 px.

    They lie 216/17 px apart, so that they fall on 17 x 17 places inside a pixel, evenly and at every scale.
    """
    side, size, focal = 17, 256, 4000.0  # far away: the same ellipse all over the image
    x = (np.arange(side) - side // 2) * 216 / side
    u, v = np.meshgrid(x, x)
    means = np.stack([u.ravel(), v.ravel(), np.full(u.size, focal)], axis=1)
    count = len(means)
    parameters = {
        "means": means,
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(0.5)),
        "logit_opacity": np.full((count, 1), -4.0),
        "sh_base": np.full((count, 3), 0.5 / 0.28209479177387814),
        "sh_rest": np.zeros((count, 0)),
    }
    gaussians = Gaussians(device, {name: table.astype(np.float32) for name, table in parameters.items()})
    camera = Camera(size, size, focal, focal, size / 2, size / 2).downscaled(scale)
    view = View("view", camera, np.eye(4)[:3], None)
    model = DeviceModel(gaussians, 0, 0.2, screen.variance, screen.compensate)
    frame = Rasterizer(device, "radix").forward(model, upload_camera(device, view), device.zeros(3))
    return float(frame.image.get().sum(dtype=np.float64)) * scale**2


@on_one_setting
def test_specks_keep_their_brightness_when_zoomed_out(device):
    """Mip and EWA to 1 % at 1/8, where a disc of 0.5 px has become 0.06 px; dilation makes it far brighter."""
    smooth = Device(device.info, device.schedule)
    smooth.tuning.update(device.tuning, ALPHA_MIN="1e-30f", TRANSMITTANCE_MIN="1e-30f")
    truth = 3 * 17**2 * 2 * np.pi * 0.25 / (1 + np.exp(4))  # 2 π σ² o of each disc and channel
    for scale in (1, 2, 4, 8):
        for screen in (Mip(), Ewa()):
            assert grid_of_specks(smooth, screen, scale) == pytest.approx(truth, rel=0.01), (screen.type, scale)
    assert grid_of_specks(smooth, Dilation(), 1) > 2 * truth
    assert grid_of_specks(smooth, Dilation(), 8) > 50 * truth


def test_screen_filter_with_a_key_without_effect_is_refused():
    count = len(Settings.subclasses)
    with pytest.raises(ConfigError, match=r"Wide: its key 'radius' has no effect; override ScreenFilter.parameters"):

        class Wide(ScreenFilter):
            radius: float = 2.0

    class Broad(ScreenFilter):
        type: Literal["broad"] = "broad"
        variance: float = 0.0
        compensate: Literal[0] = 0
        radius: float = 2.0

        def parameters(self) -> tuple[float, float, float]:
            return self.radius**2, 0.0, 0.0

    del Settings.subclasses[count:]
    assert Broad().parameters() == (4.0, 0.0, 0.0)
