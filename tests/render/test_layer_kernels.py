"""layer.cl: a layer of splats before an image, against float64."""

import pytest

from clsplat.conformance.checks.layer import layer_figures
from tests.support.figures import hold


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize(("width", "height"), [(1, 1), (15, 3), (16, 16), (17, 5), (33, 18), (65, 2), (129, 17)])
def test_both_the_loss_and_the_derivatives(device, rng, width, height, channels):
    hold(layer_figures(device, rng, width, height, channels))
