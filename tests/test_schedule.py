"""Weights over training."""

import pytest
from pydantic import ValidationError

from clsplat.losses.image import L1
from clsplat.schedule import at_step

RAMP = [[100, 0.8], [200, 0.4], [300, 4.0]]


@pytest.mark.parametrize(
    ("step", "value"), [(0, 0.8), (100, 0.8), (150, 0.6), (200, 0.4), (250, 2.2), (300, 4.0), (9999, 4.0)]
)
def test_straight_lines_between_points(step, value):
    assert at_step(L1(weight=RAMP).weight, step) == pytest.approx(value, rel=1e-12)


def test_a_number_stays():
    assert at_step(0.3, 0) == at_step(0.3, 10**6) == 0.3


@pytest.mark.parametrize(
    "points", [[], [[200, 1.0], [100, 2.0]], [[100, 1.0], [100, 2.0]], [[1, 2, 3]], [["1", 2.0]], "1"]
)
def test_points_out_of_order_are_refused(points):
    with pytest.raises(ValidationError):
        L1(weight=points)
