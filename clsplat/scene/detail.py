"""How much detail photographs show at each pixel: there Gaussians are to lie densely."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
MAX_SPACING = 0.1  # by the width of the photograph (Meuleman et al. 2025)


def laplacian_chance(image: Floats) -> Floats:
    """Return the chance, [H, W], with which a pixel of a photograph, [H, W, 3] in [0, 1], becomes a point.

    It is min(1, ‖∇²I‖₁) with the Laplacian of five points, summed over the colours (Meuleman et al. 2025).  There it is
    averaged over a disc of weight 1; here photographs are so small that each pixel is an average already, and the
    factor stays 1.  A pixel that differs from the mean of its neighbours by a twelfth of the range in each colour has
    the chance 1.
    """
    framed = np.pad(image.astype(np.float64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    middle, around = framed[1:-1, 1:-1], (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:])
    chance: Floats = np.minimum(np.abs(sum(around) - 4 * middle).sum(axis=2), 1)
    return chance


def spacing(chance: Floats, width: int) -> Floats:
    """Return the distance in pixels between points that are taken with some chances above 0: 1/√chance.

    It is at most MAX_SPACING by the width of the photograph, px.
    """
    distance: Floats = np.minimum(1 / np.sqrt(chance), MAX_SPACING * width)
    return distance
