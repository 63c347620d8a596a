"""average.cl and the stages that use it, against averages in float64."""

import numpy as np
import pytest

from clsplat.conformance.checks.averages import average_figures
from clsplat.conformance.scenes import random_case
from clsplat.gaussians.tables import PARAMETERS
from clsplat.training import average
from tests.support.figures import hold


@pytest.mark.parametrize("count", [1, 15, 16, 17, 63, 64, 65, 150])
def test_the_average_of_three_steps(device, rng, count):
    hold(average_figures(device, rng, count))


def test_rows_without_an_average_keep_values_and_tables_go(device, rng):
    gaussians = random_case(rng, 20).model(device).gaussians
    before = {name: gaussians.get(name) for name in gaussians.tables}
    average.attach(gaussians)
    average.take(gaussians)
    assert gaussians.tables.keys() == before.keys()
    for name in PARAMETERS:
        np.testing.assert_array_equal(gaussians.get(name), before[name])


def test_no_gaussian(device, rng):
    gaussians = random_case(rng, 0).model(device).gaussians
    average.attach(gaussians)
    average.add(gaussians)
    average.take(gaussians)
    assert gaussians.count == 0


def test_an_average_of_equal_values_is_the_value(device, rng):
    """To the bit, as a table of the parameters that no step changes."""
    gaussians = random_case(rng, 65).model(device).gaussians
    before = {name: gaussians.get(name) for name in PARAMETERS}
    average.attach(gaussians)
    for _ in range(7):
        average.add(gaussians)
    average.take(gaussians)
    for name in PARAMETERS:
        np.testing.assert_array_equal(gaussians.get(name), before[name])


def test_what_is_not_a_number_stays_in_its_row(device, rng):
    gaussians = random_case(rng, 17).model(device).gaussians
    means = gaussians.get("means")
    means[3] = np.nan
    gaussians.set("means", means)
    average.attach(gaussians)
    average.add(gaussians)
    average.take(gaussians)
    found = gaussians.get("means")
    assert np.isnan(found[3]).all()
    assert np.isfinite(np.delete(found, 3, axis=0)).all()
