"""A walk through the views of a scene: their order, and a smooth curve along them."""

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.video.rig import Floats, Rig

Indices = NDArray[np.intp]
DEGREE = 5  # of the B-spline
LOOSENESS = 0.25  # of the median step between neighbours: how far the curve may pass from a view
UP_WEIGHT = 0.1  # of the upward axes beside positions, times the distance
MOST_VIEWS = 1000  # of those, evenly by name, that a walk visits
ROUNDS = 20  # of shortening


def order(rig: Rig) -> Indices:
    """Return the indices of the views by name, or from neighbour to neighbour where that way is shorter, [V]."""
    spread = float(np.median(np.linalg.norm(rig.positions - np.median(rig.positions, axis=0), axis=1))) or 1.0
    places = np.hstack([rig.positions / spread, rig.forwards])
    by_name = np.array(sorted(range(len(rig.views)), key=lambda i: rig.views[i].name))
    by_name = by_name[:: -(-len(by_name) // MOST_VIEWS)]
    between = scipy.spatial.distance.cdist(places[by_name], places[by_name])
    ways = np.arange(len(by_name)), _shortened(_neighbours(between), between)
    return np.asarray(by_name[min(ways, key=lambda way: _length(between, way))])


def smooth(places: Floats, frames: int, distance: float) -> Floats:
    """Return a B-spline of degree 5 near the places at even steps, [frames, C].

    places: [V, C], positions, targets at a distance and upward axes.
    """
    weights = np.repeat([1.0, 1.0, UP_WEIGHT * distance], 3)
    scaled = places * weights
    steps = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    kept = np.append(True, steps > 1e-9 * max(1e-30, float(steps.max(initial=0.0))))  # no place twice
    scaled = scaled[kept]
    if len(scaled) == 1:
        return np.repeat(places[:1], frames, axis=0)
    loose = len(scaled) * (LOOSENESS * float(np.median(steps[kept[1:]]))) ** 2
    curve, _ = scipy.interpolate.splprep(
        scaled.T, k=min(DEGREE, len(scaled) - 1), s=loose if len(scaled) > DEGREE else 0
    )
    return np.asarray(np.stack(scipy.interpolate.splev(np.linspace(0, 1, frames), curve), axis=1) / weights)


def _neighbours(between: Floats) -> Indices:
    """From the first view always on to the nearest that is left."""
    way, left = [0], set(range(1, len(between)))
    while left:
        rest = np.array(sorted(left))
        way.append(int(rest[between[way[-1], rest].argmin()]))
        left.remove(way[-1])
    return np.array(way)


def _shortened(way: Indices, between: Floats) -> Indices:
    """Turn parts of the way round as long as that makes it shorter (2-opt)."""
    for _ in range(ROUNDS):
        changed = False
        for i in range(len(way) - 2):
            steps = np.append(between[way[i + 2 : -1], way[i + 3 :]], 0.0)  # nothing follows the last view
            ends = np.append(between[way[i + 1], way[i + 3 :]], 0.0)
            gain = between[way[i], way[i + 1]] + steps - between[way[i], way[i + 2 :]] - ends
            j = int(gain.argmax())
            if gain[j] > 1e-9:
                way[i + 1 : i + 3 + j] = way[i + 1 : i + 3 + j][::-1].copy()
                changed = True
        if not changed:
            break
    return way


def _length(between: Floats, way: Indices) -> float:
    return float(between[way[:-1], way[1:]].sum())
