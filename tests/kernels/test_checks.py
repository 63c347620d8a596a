"""The checks of `clsplat doctor` hold on the devices of the tests."""

import pytest

from clsplat.conformance.check import Note
from clsplat.conformance.checks import BITONIC, ESSENTIAL, KERNELS
from tests.kernels.figures import hold


@pytest.mark.parametrize("check", [*KERNELS, *ESSENTIAL, *BITONIC], ids=lambda check: check.name.replace(" ", "_"))
def test_the_figures_of_a_check_hold(device, check):
    hold(found for found in check.figures(device) if not isinstance(found, Note))
