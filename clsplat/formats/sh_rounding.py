"""Harmonics rounded so that little of it shows, from the model alone.

What shows of errors e of the K coefficients above band 0 is w e^T G e: w as weights.py estimates it, and G the mean of
Y(d) Y(d)^T over the directions d from which the model is seen.  Training moves coefficients along Y(d) for the cameras
that it has, so that their own second moments are an estimate of G: those of fox and lego have correlations of 0.86 and
0.88 with the G of the cameras.  From these two:

    steps  a Gaussian's step is as 1 / sqrt(w), which is the least error for a number of bits (reverse water-filling)
    order  coefficients are rounded one after another, the highest first, and those that are still to be rounded take up
           what shows of the error so far: the nearest plane of Babai (1986)
    base   what of the errors is the same from where the model is seen goes into band 0: the mean of Y(d), which follows
           from G, for products of the bands 1 to 3 span each of them
"""

import numpy as np
from numpy.typing import NDArray

from clsplat.formats.palette import LEVELS, usual_largest
from clsplat.formats.splats import SH_C0
from clsplat.harmonics import mean_basis

Floats = NDArray[np.floating]
ISOTROPIC = 0.02  # share of all directions alike beside those that the moments tell; 0.005 to 0.1 differ little
USUAL = 0.028  # root of the mean square of harmonics: fox after 7 000 steps; Lego has 0.037, the kitchen 0.043
ROWS = 1 << 15  # that are rounded at once


def steps(log_weights: NDArray[np.float64], median: float, most: float) -> NDArray[np.float32]:
    """Return a step for each Gaussian, [N]: a power of two, about `median` for the median weight, from 1 to `most`."""
    exponents = np.rint(np.log2(median) - log_weights / 2)
    return np.asarray(np.exp2(np.clip(exponents, 0, np.log2(most))), np.float32)


def usual_step(rest: Floats, step: float, most: float) -> float:
    """Return a step that is chosen for harmonics of the size USUAL, and for others in proportion, up to `most`."""
    size = float(np.sqrt(np.square(np.clip(rest, -1, 1), dtype=np.float64).mean())) if rest.size else 0.0
    return min(most, step * max(size / USUAL, 1e-3))


def visible_form(rest: Floats) -> NDArray[np.float64]:
    """Return G for harmonics [N, 3 K], as [K, K] with a trace of K, the same bits with any number of threads."""
    largest = usual_largest(rest)
    count = rest.shape[1] // 3
    form = np.zeros((count, count))
    for start in range(0, len(rest) if largest else 0, ROWS):
        block = rest[start : start + ROWS].astype(np.float64) / largest
        whole = np.rint(LEVELS * np.clip(block, -1, 1)).reshape(-1, count, 3)
        for channel in range(3):
            form += whole[:, :, channel].T @ whole[:, :, channel]
    trace = np.trace(form)
    return (form * (count / trace) if trace else form) + ISOTROPIC * np.eye(count)


def base_for(base: Floats, errors: Floats, form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return coefficients of band 0, [N, 3], that take up what is the same everywhere of errors of the others.

    errors: what the others lack, [N, 3 K].
    """
    count = len(form)
    lacking = errors.reshape(len(errors), count, 3)
    change = np.zeros(base.shape)
    for k, mean in enumerate(mean_basis(form)):
        change += mean * lacking[:, k]
    return np.asarray(base + change / SH_C0, np.float32)


def rounded_rows(rest: Floats, steps: NDArray[np.float32], form: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return harmonics [N, 3 K] as multiples of each Gaussian's step, whose errors show little by `form`, [K, K]."""
    count = len(form)
    # (G^-1) reversed = U^T U: row k of U tells how the coefficients after k take up an error of k
    inverse = np.linalg.inv(form[::-1, ::-1])
    feedback = np.linalg.cholesky(inverse).T.astype(np.float32)
    feedback /= np.diag(feedback)[:, None].copy()
    found = np.empty(rest.shape, np.float32)
    for start in range(0, len(rest), ROWS):
        part, step = rest[start : start + ROWS], steps[start : start + ROWS]
        left = np.ascontiguousarray(part.reshape(len(part), count, 3)[:, ::-1].transpose(1, 2, 0), np.float32)
        for k in range(count):
            wanted = left[k].copy()
            left[k] = np.rint(wanted / step) * step
            error = wanted - left[k]
            for later in range(k + 1, count):
                left[later] -= feedback[k, later] * error
        found[start : start + ROWS] = left[::-1].transpose(2, 0, 1).reshape(part.shape)
    return found
