"""transients.cl: residuals, their histogram, and the mask."""

import numpy as np

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.images import SCALES, check_transient, make_camera, to_planes
from clsplat.render.workspace import Workspace
from clsplat.training.modules.transients import BINS, mask_transients, measure_residuals
from tests.support.deviations import assert_within_bounds
from tests.support.device_images import SIZES
from tests.support.devices import each_once, on_devices, product


@on_devices("width, height, scale, share", each_once(SIZES, product(SCALES, [None, 0.5, 0.0])))
def test_residuals_histogram_and_masks_match_the_reference(device, rng, width, height, scale, share):
    assert_within_bounds(check_transient(device, rng, width, height, scale, share))


def test_bin_starts_at_its_upper_bits(device):
    """A residual on an edge is in the bin above."""
    edges = (2.0**-12 * 2.0 ** (np.arange(BINS) // 8) * (1 + np.arange(BINS) % 8 / 8)).astype(np.float32)
    for values in (edges, np.nextafter(edges[1:], np.float32(0))):
        x = np.zeros((3, 1, len(values)), np.float32)
        x[1] = 3 * values  # the mean of the channels is exact
        camera = make_camera(device, len(values), 1)
        planes = to_planes(device, camera, x), to_planes(device, camera, np.zeros_like(x))
        numbers = measure_residuals(Workspace(device), camera, *planes, None)[1]()
        np.testing.assert_array_equal(numbers, ref.residual_histogram(values.astype(np.float64)))


def test_nan_is_left_for_the_losses(device):
    x = np.zeros((3, 4, 5), np.float32)
    x[1, 2, 3] = np.nan
    camera = make_camera(device, 5, 4)
    planes = to_planes(device, camera, x), to_planes(device, camera, np.zeros_like(x))
    workspace = Workspace(device)
    residuals, numbers = measure_residuals(workspace, camera, *planes, None)
    assert numbers().sum() == 20
    mask = mask_transients(workspace, camera, residuals, 1e-3, 1).get()[0]
    assert mask.sum() == mask[:4, :5].sum() == 20
