"""fusion.cl against the reference."""

from clsplat.conformance.checks.images import fusion
from tests.support.deviations import assert_within_bounds


def test_fusion_of_depth_images(device, rng):
    assert_within_bounds(fusion(device, rng))
