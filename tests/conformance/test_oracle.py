"""Images and gradients of the device against an oracle that shares no code with the project's reference."""

import pytest

from tests.conformance.oracle import FILTERS, KINDS, TABLES, errors


@pytest.mark.parametrize(("number", "kind"), enumerate(KINDS))
def test_image_and_gradients_equal_the_oracle(device, number, kind):
    screen_filter = list(FILTERS)[number % len(FILTERS)]
    result = errors(device, kind, screen_filter, seed=2)
    image, median, worst = (1e-4, 1e-4, 1e-3) if "needles" in kind else (5e-6, 5e-6, 5e-5)
    assert result["image"][1] < image
    assert result["alpha"][1] < image
    assert result["depth"][1] < image
    for name in TABLES:
        assert result[name][0] < median, name
        assert result[name][1] < worst, name
