"""texture.cl against SciPy's Sobel filter."""

import numpy as np
import pytest
from scipy import ndimage

from clsplat.conformance.checks.images import make_camera
from clsplat.conformance.scenes import random_case
from clsplat.photos.photographs import Photograph, compute_texture_quantile, unmasked_gradient
from clsplat.render.rasterizer import Rasterizer
from clsplat.render.workspace import Workspace
from tests.support.devices import on_devices

SIZES = ((1, 1), (2, 3), (7, 5), (8, 8), (9, 2), (15, 4), (16, 16), (17, 17), (40, 30), (65, 3))


def magnitude_of(image: np.ndarray) -> np.ndarray:
    """|Sobel| / 8 of the luminance of [3, H, W], float64."""
    luminance = np.tensordot([0.299, 0.587, 0.114], image.astype(np.float64), axes=1)
    across, down = (ndimage.sobel(luminance, axis=axis, mode="nearest") for axis in (1, 0))
    return np.hypot(across, down) / 8


@on_devices("width, height", SIZES)
def test_image_gradient(device, rng, width, height):
    camera = make_camera(device, width, height)
    image = rng.uniform(0, 1, (3, height, width)).astype(np.float32)
    planes = np.zeros((3, camera.rows, camera.stride), np.float32)
    planes[:, :height, :width] = image
    magnitude = device.zeros((camera.rows, camera.stride))
    magnitude.fill(9)
    device.program("texture.cl").image_gradient(
        items=(-(-camera.stride // int(device.tuning["LANES"])), camera.rows),
        image=device.upload(planes),
        magnitude=magnitude,
        width=width,
        height=height,
        rows=camera.rows,
        stride=camera.stride,
    )
    result = magnitude.get()
    np.testing.assert_allclose(result[:height, :width], magnitude_of(image), atol=1e-6)
    result[:height, :width] = 0
    assert (result == 0).all()


@on_devices("width, height", SIZES)
def test_masked_pixels_have_no_texture(device, rng, width, height):
    """Nor have its neighbors, and neither the texture nor its quantiles depend on what is hidden."""
    camera, workspace = make_camera(device, width, height), Workspace(device)
    mask = rng.random((height, width)) < 0.9
    known = ndimage.minimum_filter(mask, 3, mode="nearest")
    results = []
    for filling in (rng.integers(0, 256, (3, height, width)) for _ in range(2)):
        pixels = np.where(mask, np.arange(3 * width * height).reshape(3, height, width) * 37 % 256, filling)
        photograph = Photograph(
            camera, device.upload(pixels.astype(np.uint8)), device.upload(mask[None].astype(np.uint8))
        )
        planes = photograph.planes(workspace)
        texture = unmasked_gradient(workspace, camera, planes.colors, planes.mask).get()
        expected = np.where(known, magnitude_of(pixels / 255), -1)
        np.testing.assert_allclose(texture[:height, :width], expected, atol=1e-6)
        texture[:height, :width] = 0
        assert (texture == 0).all()
        results.append(compute_texture_quantile(workspace, [photograph], 0.5))
    assert results[0] == results[1]
    if known.any():
        assert results[0] == pytest.approx(
            np.quantile(magnitude_of(pixels / 255)[known], 0.5, method="inverted_cdf"), abs=3e-4
        )


@on_devices("count", [1, 63, 64, 65, 150])
def test_sample_at_projected_means(device, rng, count):
    case = random_case(rng, count, 40, 30)
    rasterizer = Rasterizer(device, "radix")
    frame = rasterizer.forward(case.model(device), case.device_camera(device), device.zeros(3))
    magnitude = rng.uniform(0, 1, (frame.camera.rows, frame.camera.stride)).astype(np.float32)
    magnitude[rng.random(magnitude.shape) < 0.2] = -1
    total = device.zeros(frame.radius.shape)
    for _ in range(2):
        device.program("texture.cl").sample_magnitude(
            items=count,
            magnitude=device.upload(magnitude),
            splats=frame.splats,
            radius=frame.radius,
            total=total,
            width=40,
            height=30,
            stride=frame.camera.stride,
            count=count,
        )
    x, y = frame.splats.get()[:count, :2].T
    column, row = np.clip(x, 0, 39).astype(int), np.clip(y, 0, 29).astype(int)
    visible = frame.radius.get()[:count] > 0
    np.testing.assert_allclose(total.get()[:count], 2 * np.maximum(magnitude[row, column], 0) * visible, rtol=1e-6)
