"""What kernel tests assert of the figures that checks of a device yield."""

from collections.abc import Iterable

from clsplat.conformance.comparison import Figure


def hold(figures: Iterable[Figure]) -> None:
    """Fail with a sentence for every figure beyond its bound, and where there is none."""
    found = list(figures)
    assert found
    assert not [figure.text for figure in found if not figure.holds]
