"""How much each Gaussian is estimated to contribute to pictures, from the model alone.

An error of a Gaussian's colour shows in a picture by the squares of its blend weights.  They grow with its opacity and
with its size in the picture, and fall with what lies before it, which no table tells:

    w = opacity * sqrt(area) / distance,  area: the product of its two largest scales

The distance is to the middle of the model, for cameras are not known.  A root of the area, not the area: large
Gaussians are covered more often, and with a larger power fox and lego lose more at the same size.

Medians are over the scene.  Where the model's file notes that Gaussians are a sky, thousands on a far sphere, these are
weighed but not counted in them: they would decide how finely the scene is rounded.
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.splats import Parameters

LARGEST = 10.0  # of the logarithms, on both sides of 0
# A sky is behind a gap: a distance within which are all but a few, and behind it many.  The spheres of
# gaussians/sky_splats.py are 10 times as far as 97 % of the scene.  Their rows are found by it, not by their number:
# models are cropped, merged to fewer Gaussians, sorted and rounded afterwards.
GAP, INSIDE = 5.0, 0.97
FEWEST_INSIDE, FEWEST_BEHIND = 0.01, 0.05  # of all


def log_weights(p: Parameters, has_sky: bool = False) -> NDArray[np.float64]:
    """Return the binary logarithms of the weights, [N], of which the scene's median is 0; from -LARGEST to LARGEST.

    Scale-free: a model that is twice as large has the same.  has_sky: whether some Gaussians are a sky, which the
    median leaves out.
    """
    if not len(p["means"]):
        return np.zeros(0)
    means, scales = p["means"].astype(np.float64), np.sort(p["log_scales"].astype(np.float64), axis=1)
    squares = np.square(means - np.median(means, axis=0)).sum(axis=1)
    counted = before_a_gap(np.sqrt(squares)) if has_sky else np.ones(len(squares), np.bool_)
    squares += np.maximum(np.median(squares[counted]), 1e-30)
    opacity = -np.logaddexp(0, -p["logit_opacity"][:, 0].astype(np.float64))
    found = (opacity + (scales[:, 1] + scales[:, 2] - np.log(squares)) / 2) / np.log(2)
    return np.asarray(np.clip(found - np.median(found[counted]), -LARGEST, LARGEST))


def before_a_gap(distances: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of these distances, [N], are not behind a gap, as those of a sky are; all where there is none.

    A sky lies around the scene, so that the median of all positions is in the scene's middle.
    """
    ordered, count = np.sort(distances), len(distances)
    within = np.arange(1, count + 1)
    inside = np.searchsorted(ordered, ordered / GAP, side="right")
    ends = (inside >= INSIDE * within) & (within >= FEWEST_INSIDE * count) & (count - within >= FEWEST_BEHIND * count)
    ends &= ordered > 0
    return distances <= ordered[ends][-1] / 2 if ends.any() else np.ones(count, np.bool_)
