"""The mean of a Gaussian over the box of a pixel, as the kernels approximate it (cl_kernels/pixel_box.h).

With y the pixel axis of the larger variance (x and y change places otherwise): the marginal of y over the pixel's
height, times that of x given y over its width, given the mean and the variance of y within the pixel.  Φ is a logistic
function of an odd polynomial.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]
SLOPE, CUBIC, QUINTIC = 1.5957691, 0.07333173, -0.00059424  # Φ(x) = 1 / (1 + e^-P), P = SLOPE x + CUBIC x³ + …
REACH = 6.0  # of Φ, standard deviations
UNIFORM = 0.4  # a pixel below this many standard deviations from its centre to its edge: m and v by their series
STEP = 1e-5  # of finite differences, px or px², by the size of what changes


def cdf(x: Floats) -> Floats:
    x = np.clip(x, -REACH, REACH)
    square = x * x
    return 1 / (1 + np.exp(-x * (SLOPE + square * (CUBIC + square * QUINTIC))))


def density(x: Floats) -> Floats:
    x = np.clip(x, -REACH, REACH)
    square, share = x * x, cdf(x)
    return share * (1 - share) * (SLOPE + square * (3 * CUBIC + square * (5 * QUINTIC)))


def moments(dy: Floats, s: float) -> tuple[Floats, Floats, Floats]:
    """Share Z of a normal distribution that lies within ½ of `dy`, and the mean and the variance there; dy >= 0."""
    below, above = -(dy + 0.5) / s, -(dy - 0.5) / s  # mirrored, where Φ is small and exact
    share = np.maximum(cdf(above) - cdf(below), 1e-30)
    if 0.5 / s < UNIFORM:
        tilt = dy / s**2
        mean = dy - tilt * (1 / 12 - 1 / (360 * s**2) - tilt**2 / 720)
        return share, mean, np.maximum(1 / 12 - 1 / (360 * s**2) - tilt**2 / 240, 0)
    below, above = np.clip(below, -REACH, REACH), np.clip(above, -REACH, REACH)
    mean = (density(below) - density(above)) / share
    variance = 1 + (below * density(below) - above * density(above)) / share - mean**2
    return share, np.clip(-mean * s, dy - 0.5, dy + 0.5), np.clip(variance * s**2, 0, 1 / 12)


def box_response(covariance: Floats, dx: Floats, dy: Floats) -> Floats:
    """Mean over the pixel at (dx, dy) px of e^(-dᵀ V⁻¹ d / 2), V = [xx, xy, yy] px²."""
    xx, xy, yy = covariance
    if xx > yy:
        return box_response(np.array([yy, xy, xx]), dy, dx)
    k, sy, sx = xy / yy, np.sqrt(yy), np.sqrt(xx - xy * xy / yy)
    share, mean, variance = moments(np.abs(dy), sy)
    mean = np.where(dy < 0, -mean, mean)
    r = 12 * k * k * variance
    width = (1 + r * r) ** 0.25
    blur = np.sqrt(sx * sx + (1 + r - width * width) / 12)
    offset = -np.abs(dx - k * mean)
    across = cdf((offset + width / 2) / blur) - cdf((offset - width / 2) / blur)
    return np.asarray(2 * np.pi * sy * sx * share / width * across)


def box_derivatives(covariance: Floats, dx: Floats, dy: Floats) -> tuple[Floats, ...]:
    """d(response) by dx, dy, xx, xy, yy: central differences, on the same side of xx = yy."""

    def change(size: float, **by: float) -> Floats:
        ends = []
        for sign in (1, -1):
            v = covariance + sign * size * np.array([by.get("xx", 0), by.get("xy", 0), by.get("yy", 0)])
            ends.append(box_response(v, dx + sign * size * by.get("x", 0), dy + sign * size * by.get("y", 0)))
        return (ends[0] - ends[1]) / (2 * size)

    xx, xy, yy = covariance
    place = STEP * np.sqrt(xx - xy * xy / yy)
    area = STEP * (xx * yy - xy * xy) / max(xx, yy)
    return (
        change(place, x=1),
        change(place, y=1),
        change(area, xx=1),
        change(area, xy=1),
        change(area, yy=1),
    )
