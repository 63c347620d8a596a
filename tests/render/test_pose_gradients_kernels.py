"""Derivatives by the place of a camera (poses.cl) against float64."""

import pytest

from clsplat.conformance.checks.poses import pose_figures, poses
from clsplat.conformance.scenes import random_case
from tests.support.figures import hold


def test_derivatives_by_a_pose(device, rng):
    hold(poses(device, rng))


@pytest.mark.parametrize("count", [16, 64, 511, 513])
def test_sums_over_groups(device, rng, count):
    hold(pose_figures(device, random_case(rng, count), rng, f"{count} Gaussians"))
