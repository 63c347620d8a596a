"""loss.cl: photographs whose mask is an array of its own."""

import numpy as np
import pytest

from clsplat.conformance.checks.images import camera_of
from clsplat.render.workspace import Workspace
from clsplat.views.photographs import Photograph, apply_mask
from tests.support.device_images import SIZES


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_a_mask_blackens_what_it_leaves_out(device, rng, width, height):
    camera = camera_of(device, width, height)
    colours = rng.integers(0, 256, (3, height, width)).astype(np.uint8)
    mask = (rng.random((1, height, width)) < 0.5).astype(np.uint8)
    photograph = Photograph(camera, device.upload(colours), device.upload(mask))
    assert photograph.nbytes == 4 * width * height
    np.testing.assert_array_equal(photograph.image(), colours.transpose(1, 2, 0))
    np.testing.assert_array_equal(photograph.counted(), mask[0] > 0)
    workspace = Workspace(device)
    planes = photograph.planes(workspace)
    before, counted = planes.colours.get(), planes.mask.get()
    np.testing.assert_array_equal(counted[:, :height, :width], mask)
    assert (counted[:, height:] == 0).all()
    apply_mask(workspace, camera, planes.colours, planes.mask)
    np.testing.assert_array_equal(planes.colours.get(), before * counted)


def test_a_photograph_without_a_mask_counts_everywhere(device, rng):
    photograph = Photograph(camera_of(device, 5, 3), device.upload(rng.integers(0, 256, (3, 3, 5)).astype(np.uint8)))
    assert photograph.planes(Workspace(device)).mask is None
    assert photograph.counted() is None
    assert photograph.nbytes == 45
