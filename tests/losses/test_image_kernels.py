"""loss.cl: values and gradients against the reference, also with a separate mask."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.conformance import reference as ref
from clsplat.conformance.checks.images import LOSSES, check_loss, make_camera, make_comparison
from clsplat.conformance.checks.images import image_pair as images
from clsplat.core.errors import DataError
from clsplat.core.settings import variants
from clsplat.losses.base import ImageLoss
from clsplat.losses.image import L1, L2, Dssim, add_losses, ssim_maps
from clsplat.photos.photographs import Photograph, apply_mask, unpack
from clsplat.render.workspace import Workspace
from tests.support.deviations import assert_within_bounds
from tests.support.device_images import SIZES, gradient_of
from tests.support.devices import each_once, on_devices, on_one_setting


@on_devices("width, height, loss, oracle, kernel", each_once(SIZES, LOSSES))
def test_value_and_gradient(device, rng, width, height, loss, oracle, kernel):
    x, y = images(rng, width, height)
    assert_within_bounds(check_loss(device, loss(weight=0.7), 0.7, oracle, kernel, x, y))


@on_one_setting
def test_ssim_of_too_many_pixels_is_refused_before_allocation(device, rng):
    comparison = make_comparison(device, *images(rng, 5, 3))
    tile = comparison.camera.tile
    large = replace(comparison.camera, width=2**15, height=2**14, tiles_x=2**15 // tile, tiles_y=2**14 // tile)
    with pytest.raises(DataError, match=r"32768x16384 pixels is too large for SSIM \(at most 477,218,588\)"):
        ssim_maps(replace(comparison, camera=large))
    assert comparison.workspace.nbytes < 2**20


@on_one_setting
def test_losses_add_up(device, rng):
    x, y = images(rng, 50, 20)
    comparison = make_comparison(device, x, y)
    L1(weight=0.8).add(comparison)
    Dssim(weight=0.2).add(comparison)
    L2(weight=3.0).add(comparison)
    x, y = x.astype(np.float64), y.astype(np.float64)
    expected = 0.8 * ref.l1(x, y)[1] + 0.2 * ref.dssim(x, y)[1] + 3 * ref.l2(x, y)[1]
    np.testing.assert_allclose(gradient_of(comparison), expected, atol=2e-4 * np.abs(expected).max())


@on_devices("width, height", SIZES)
def test_l1_in_the_ssim_kernel_equals_separate_kernels(device, rng, width, height):
    """Bit for bit, in each order with an L2."""
    x, y = images(rng, width, height)
    l1, dssim, l2 = L1(weight=0.8), Dssim(weight=0.2), L2(weight=3.0)
    for losses in ([l1, dssim], [l2, l1, dssim], [l1, dssim, l2]):
        together, separate = make_comparison(device, x, y), make_comparison(device, x, y)
        values = add_losses(losses, together)
        assert [value.name for value in values] == [loss.type for loss in losses]
        expected = [loss.add(separate).value() for loss in losses]
        assert [value.value() for value in values] == pytest.approx(expected, rel=1e-6)
        np.testing.assert_array_equal(together.gradient.get(), separate.gradient.get())


@on_one_setting
def test_equal_images_have_zero_loss(device, rng):
    x, _ = images(rng, 40, 30)
    for loss in (kind for kind in variants(ImageLoss).values() if kind.reads_photograph):
        comparison = make_comparison(device, x, x)
        assert loss().add(comparison).value() == pytest.approx(0, abs=1e-6)
        assert np.abs(gradient_of(comparison)).max() < 1e-7


def test_dssim_gradient_of_flat_images_stays_small(device):
    """Variances are zero: rounding must not make the gradient blow up."""
    x, y = np.full((3, 30, 40), 0.999, np.float32), np.full((3, 30, 40), 1.0, np.float32)
    comparison = make_comparison(device, x, y)
    Dssim().add(comparison)
    expected = ref.dssim(x.astype(np.float64), y.astype(np.float64))[1]
    assert np.abs(gradient_of(comparison) - expected).max() < 2e-7


@on_devices("width, height", SIZES[3:9])
def test_pixels_are_unpacked_and_scaled(device, rng, width, height):
    pixels = rng.integers(0, 256, (4, height, width)).astype(np.uint8)
    camera = make_camera(device, width, height)
    workspace = Workspace(device)
    workspace.array("photograph", (4, camera.rows, camera.stride)).fill(9)
    for channels, factor in ((3, 1 / 255), (1, 1.0), (4, 0.5)):
        planes = unpack(workspace, camera, device.upload(pixels[:channels]), factor, "photograph").get()
        assert planes.shape == (channels, camera.rows, camera.stride)
        np.testing.assert_allclose(planes[:, :height, :width], pixels[:channels] * factor, rtol=1e-6)
        assert (planes[:, height:] == 0).all()
        assert (planes[:, :, width:] == 0).all()


@on_one_setting
def test_ssim_against_scikit_image(device, rng):
    """Away from the border, where padding does not matter, the map's mean is scikit-image's."""
    metrics = pytest.importorskip("skimage.metrics")
    x, y = images(rng, 64, 48)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, full = metrics.structural_similarity(x, y, channel_axis=0, full=True, **options)
    oracle = ref.ssim_map(x.astype(np.float64), y.astype(np.float64))
    np.testing.assert_allclose(full[:, 5:-5, 5:-5], oracle[:, 5:-5, 5:-5], atol=1e-5)
    _, sums = ssim_maps(make_comparison(device, x, y))
    assert sums.get().sum(dtype=np.float64) / x.size == pytest.approx(oracle.mean(), rel=1e-5)


@on_devices("width, height", SIZES[3:9])
def test_mask_blackens_excluded_pixels(device, rng, width, height):
    camera = make_camera(device, width, height)
    colors = rng.integers(0, 256, (3, height, width)).astype(np.uint8)
    mask = (rng.random((1, height, width)) < 0.5).astype(np.uint8)
    photograph = Photograph(camera, device.upload(colors), device.upload(mask))
    assert photograph.nbytes == 4 * width * height
    np.testing.assert_array_equal(photograph.image(), colors.transpose(1, 2, 0))
    np.testing.assert_array_equal(photograph.unmasked_pixels(), mask[0] > 0)
    workspace = Workspace(device)
    planes = photograph.planes(workspace)
    before, counted = planes.colors.get(), planes.mask.get()
    np.testing.assert_array_equal(counted[:, :height, :width], mask)
    assert (counted[:, height:] == 0).all()
    apply_mask(workspace, camera, planes.colors, planes.mask)
    np.testing.assert_array_equal(planes.colors.get(), before * counted)


@on_one_setting
def test_photograph_without_a_mask_counts_everywhere(device, rng):
    photograph = Photograph(make_camera(device, 5, 3), device.upload(rng.integers(0, 256, (3, 3, 5)).astype(np.uint8)))
    assert photograph.planes(Workspace(device)).mask is None
    assert photograph.unmasked_pixels() is None
    assert photograph.nbytes == 45
