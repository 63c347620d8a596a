"""loss.cl: values and gradients against the oracle."""

import numpy as np
import pytest

from clsplat.losses.base import Comparison, ImageLoss
from clsplat.losses.image import L1, L2, Dssim, ssim_maps
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.settings import variants
from clsplat.views.photographs import unpack
from tests import reference_loss as ref_loss

# around the window (11), vectors (8, 16), tiles (16) and the columns of a group (256)
SIZES = ((1, 1), (5, 3), (11, 11), (16, 16), (17, 33), (100, 31), (255, 12), (256, 6), (257, 9), (600, 4))


def camera_of(device, width: int, height: int) -> DeviceCamera:
    tile = int(device.tuning["TILE"])
    return DeviceCamera(device.zeros(1), width, height, -(-width // tile), -(-height // tile), tile)


def comparison_of(device, x: np.ndarray, y: np.ndarray) -> Comparison:
    """x, y: [3, H, W]."""
    camera = camera_of(device, x.shape[2], x.shape[1])

    def planes(image: np.ndarray) -> np.ndarray:
        padded = np.zeros((3, camera.rows, camera.stride), np.float32)
        padded[:, : camera.height, : camera.width] = image
        return padded

    gradient = device.empty((3, camera.rows, camera.stride))
    gradient.fill(7)
    return Comparison(Workspace(device), camera, device.upload(planes(x)), device.upload(planes(y)), gradient)


def images(rng, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    y = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    return (y + rng.normal(0, 0.2, y.shape)).astype(np.float32), y


def gradient_of(comparison: Comparison) -> np.ndarray:
    """The gradient inside the image; outside it must be zero."""
    planes, camera = comparison.gradient.get(), comparison.camera
    assert (planes[:, camera.height :] == 0).all()
    assert (planes[:, :, camera.width :] == 0).all()
    return planes[:, : camera.height, : camera.width]


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize(("loss", "oracle"), [(L1, ref_loss.l1), (L2, ref_loss.l2), (Dssim, ref_loss.dssim)])
def test_value_and_gradient(device, rng, width, height, loss, oracle):
    x, y = images(rng, width, height)
    comparison = comparison_of(device, x, y)
    found = loss(weight=0.7).add(comparison)
    value, gradient = oracle(x.astype(np.float64), y.astype(np.float64))
    assert found.value() == pytest.approx(0.7 * value, rel=1e-5, abs=1e-7)
    error = np.abs(gradient_of(comparison) - 0.7 * gradient)
    assert error.max() < 2e-4 * np.abs(0.7 * gradient).max()


def test_losses_add_up(device, rng):
    x, y = images(rng, 50, 20)
    comparison = comparison_of(device, x, y)
    L1(weight=0.8).add(comparison)
    Dssim(weight=0.2).add(comparison)
    L2(weight=3.0).add(comparison)
    x, y = x.astype(np.float64), y.astype(np.float64)
    expected = 0.8 * ref_loss.l1(x, y)[1] + 0.2 * ref_loss.dssim(x, y)[1] + 3 * ref_loss.l2(x, y)[1]
    np.testing.assert_allclose(gradient_of(comparison), expected, atol=2e-4 * np.abs(expected).max())


def test_equal_images_have_no_loss(device, rng):
    x, _ = images(rng, 40, 30)
    for loss in variants(ImageLoss).values():
        comparison = comparison_of(device, x, x)
        assert loss().add(comparison).value() == pytest.approx(0, abs=1e-6)
        assert np.abs(gradient_of(comparison)).max() < 1e-7


def test_flat_images(device):
    """Variances are zero: rounding must not make the gradient blow up."""
    x, y = np.full((3, 30, 40), 0.999, np.float32), np.full((3, 30, 40), 1.0, np.float32)
    comparison = comparison_of(device, x, y)
    Dssim().add(comparison)
    expected = ref_loss.dssim(x.astype(np.float64), y.astype(np.float64))[1]
    assert np.abs(gradient_of(comparison) - expected).max() < 2e-7


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_pixels_are_unpacked_times_a_factor(device, rng, width, height):
    pixels = rng.integers(0, 256, (4, height, width)).astype(np.uint8)
    camera = camera_of(device, width, height)
    workspace = Workspace(device)
    workspace.array("photograph", (4, camera.rows, camera.stride)).fill(9)
    for channels, factor in ((3, 1 / 255), (1, 1.0), (4, 0.5)):
        planes = unpack(workspace, camera, device.upload(pixels[:channels]), factor, "photograph").get()
        assert planes.shape == (channels, camera.rows, camera.stride)
        np.testing.assert_allclose(planes[:, :height, :width], pixels[:channels] * factor, rtol=1e-6)
        assert (planes[:, height:] == 0).all()
        assert (planes[:, :, width:] == 0).all()


def test_ssim_against_scikit_image(device, rng):
    """Away from the border, where padding does not matter, the map's mean is scikit-image's."""
    metrics = pytest.importorskip("skimage.metrics")
    x, y = images(rng, 64, 48)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, full = metrics.structural_similarity(x, y, channel_axis=0, full=True, **options)
    oracle = ref_loss.ssim_map(x.astype(np.float64), y.astype(np.float64))
    np.testing.assert_allclose(full[:, 5:-5, 5:-5], oracle[:, 5:-5, 5:-5], atol=1e-5)
    _, sums = ssim_maps(comparison_of(device, x, y))
    assert sums.get().sum(dtype=np.float64) / x.size == pytest.approx(oracle.mean(), rel=1e-5)
