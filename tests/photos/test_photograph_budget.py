"""Device memory is counted, and photographs stay within their budget."""

import gc
from dataclasses import replace

import numpy as np
import pytest

from clsplat.core.errors import DataError
from clsplat.opencl.device import Device
from clsplat.opencl.discovery import DeviceInfo
from clsplat.photos.photographs import Photographs
from clsplat.render.camera import upload_camera
from clsplat.scene.detect import read_scene


@pytest.fixture
def any_device(info: DeviceInfo) -> Device:
    """What is held of photographs depends on no schedule."""
    return Device(info)


def test_live_buffers_are_counted(device):
    gc.collect()
    before = device.allocated
    first, two = device.empty(1000), device.zeros((3, 500), np.uint32)
    assert device.allocated - before == 4032 + 6016  # whole lines of 64 bytes
    assert device.peak >= device.allocated
    del first
    assert device.allocated - before == 6016
    del two
    assert device.allocated == before


@pytest.mark.parametrize("kept", [0, 3, 100])
def test_images_stay_within_the_budget(any_device, tiny_scene, kept):
    views = read_scene(tiny_scene).split("train")
    size = 3 * views[0].camera.width * views[0].camera.height
    tight, plenty = Photographs(any_device, "white", budget=kept * size), Photographs(any_device, "white")
    for turn in range(3):
        tight.prefetch(views[turn : turn + 2])
        for view in views:
            np.testing.assert_array_equal(tight.get(view).image(), plenty.get(view).image())
            assert sum(held.nbytes for held in tight._cache.values()) <= max(kept, 1) * size


@pytest.mark.parametrize("kept", [0, 100])
def test_photograph_has_the_camera_of_the_requested_view(any_device, tiny_scene, kept):
    """Whatever camera the same photograph had before: one of a measurement, in a training that learns cameras."""
    view = read_scene(tiny_scene).views[0]
    other = replace(
        view, camera=view.camera.zoomed(0.9), world_to_camera=view.world_to_camera + np.float64([0, 0, 0, 0.1])
    )
    photographs = Photographs(any_device, "white", budget=kept << 20)
    for item in (other, view, other):
        expected = upload_camera(any_device, item)
        for camera in (photographs.get(item).camera, photographs.camera(item)):
            assert camera.values == expected.values
            np.testing.assert_array_equal(camera.array.get(), expected.array.get())


def test_prefetched_damaged_image_is_reported_on_request(any_device, tiny_scene, tmp_path):
    damaged = tmp_path / "damaged.png"
    damaged.write_bytes(b"not an image")
    view = replace(read_scene(tiny_scene).split("train")[0], image_path=damaged)
    photographs = Photographs(any_device, "white")
    photographs.prefetch([view])
    with pytest.raises(DataError, match=r"damaged\.png"):
        photographs.get(view)
