"""How much each Gaussian is estimated to contribute to pictures, from the model alone.

An error of a Gaussian's colour shows in a picture by the squares of its blend weights.  They grow with its opacity and
with its size in the picture, and fall with what lies before it, which no table tells:

    w = opacity * sqrt(area) / distance,  area: the product of its two largest scales

The distance is to the middle of the model, for cameras are not known.  A root of the area, not the area: large
Gaussians are covered more often, and with a larger power fox and lego lose more at the same size.
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.splats import Parameters

LARGEST = 10.0  # of the logarithms, on both sides of 0


def log_weights(p: Parameters) -> NDArray[np.float64]:
    """Return the binary logarithms of the weights, [N], of which the median is 0; from -LARGEST to LARGEST.

    Scale-free: a model that is twice as large has the same.
    """
    if not len(p["means"]):
        return np.zeros(0)
    means, scales = p["means"].astype(np.float64), np.sort(p["log_scales"].astype(np.float64), axis=1)
    squares = np.square(means - np.median(means, axis=0)).sum(axis=1)
    squares += np.maximum(np.median(squares), 1e-30)
    opacity = -np.logaddexp(0, -p["logit_opacity"][:, 0].astype(np.float64))
    found = (opacity + (scales[:, 1] + scales[:, 2] - np.log(squares)) / 2) / np.log(2)
    return np.asarray(np.clip(found - np.median(found), -LARGEST, LARGEST))
