"""Lists that several groups of the backward pass share in simt, compared with one group a list."""

import numpy as np
import pytest

from clsplat.conformance.checks.blending import make_faint
from clsplat.conformance.scenes import random_case
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import RECORD, Rasterizer, RenderLimits
from tests.support.devices import NAMES

ONE_GROUP = {"BUCKET": 1 << 20}
in_simt = pytest.mark.parametrize("device", [(name, s) for name in NAMES for s in ("simt", "simt16")], indirect=True)


def sums(device, case, content, **limits) -> tuple[np.ndarray, int]:
    """Sums over pixels, [PIXEL_SUMS, N], and the longest list."""
    rasterizer = Rasterizer(device, "radix", RenderLimits(**limits) if limits else None)
    model, camera = case.model(device), case.device_camera(device)
    frame = rasterizer.forward(model, camera, device.zeros(3), content)
    planes = np.zeros(frame.image.shape, np.float32)
    planes[:, : camera.height, : camera.width] = np.random.default_rng(3).normal(size=(len(planes), *case.size[::-1]))
    longest = int(np.diff(frame.lists.tile_offset.get()[: camera.tiles + 1].astype(int)).max())
    rasterizer.workspace.array("pair_sums", (max(frame.lists.pairs, 1), RECORD)).fill(np.nan)  # all are overwritten
    result = rasterizer.pixel_sums(model, frame, device.upload(planes)).get()[:, : model.gaussians.count]
    return result.astype(np.float64), longest


@in_simt
@pytest.mark.parametrize("content", ["color", "inverse_depth"])
def test_buckets_change_only_the_rounding(device, rng, content):
    whole = Device(device.info, device.schedule)
    whole.tuning.update(device.tuning, **ONE_GROUP)
    for count in (511, 512, 513, 1024, 1025):
        case = random_case(rng, count, 6, 5)
        make_faint(case.parameters)
        (actual, longest), (expected, _) = sums(device, case, content), sums(whole, case, content)
        assert longest == count
        if count <= 512:
            np.testing.assert_array_equal(actual, expected)
        else:
            error = np.linalg.norm(actual - expected, axis=1) / np.linalg.norm(expected, axis=1)
            assert error.max() < 1e-5  # sums of 30 pixels, which cancel


@in_simt
def test_limits_do_not_change_the_sums_of_long_lists(device, rng):
    case = random_case(rng, 700, 20, 35)
    make_faint(case.parameters)
    expected, longest = sums(device, case, "color")
    assert longest > 512
    for limits in ({"pairs": 1 << 20, "tiles": 1}, {"pairs": 5000}):
        np.testing.assert_array_equal(sums(device, case, "color", **limits)[0], expected)
