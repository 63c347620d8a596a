"""Evaluate and rotate real spherical harmonics, as defined in cl_kernels/harmonics.h."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

# sampled directions: enough to fit the 7 functions of band 3 and, with the opposite directions, all products of two
DIRECTIONS = 64
BAND_0 = 0.28209479177387814  # the basis function of band 0, a constant
BLOCK_ROWS = 4096  # Gaussians per block, to limit temporary memory
Floats = NDArray[np.float64]
MEAN_DECIMALS = 6  # decimals of means; further digits differ between processors


def basis(directions: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the basis functions of bands 1 to 3, [M, 15], evaluated at unit directions, [M, 3]."""
    x, y, z = directions.astype(np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    values = [
        *(-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * zz - xx - yy)),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (xx - yy)),
        *(-0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z),
        *(-0.4570457994644658 * y * (4 * zz - xx - yy), 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy)),
        *(-0.4570457994644658 * x * (4 * zz - xx - yy), 1.445305721320277 * z * (xx - yy)),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(values, axis=1)


def mean_basis(form: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of the basis functions Y(d), [K], over a distribution of directions d.

    `form`, [K, K], is proportional to the mean of Y(d) Y(d)^T.  Products of two functions of bands 1 to 3 span all
    functions of these bands.  Products of two functions of band 1 do not span band 1, so the result is 0 if
    band 1 is the only one.
    """
    count, directions = len(form), _directions()
    values = basis(np.concatenate([directions, -directions]))[:, :count]
    pairs = np.triu_indices(count)
    products = values[:, pairs[0]] * values[:, pairs[1]]
    product_coefficients = np.linalg.lstsq(products, values, rcond=1e-9)[0]
    moments = form * (count / (4 * np.pi) / np.trace(form))  # |Y|² = K / 4 pi in every direction
    mean = moments[pairs] @ product_coefficients
    norm2 = mean @ np.linalg.solve(moments, mean)  # at most 1 for a distribution; noise in `form` can exceed it
    return np.asarray(np.round(mean / np.sqrt(max(norm2, 1.0)), MEAN_DECIMALS))


def rotate_sh(sh_rest: NDArray[np.floating], rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate SH coefficients, [N, (K-1)*3] in coefficient-major order, by a rotation matrix, [3, 3].

    A rotation maps each band onto itself, so each band's matrix follows from values in a few directions.
    """
    count, coefficients = len(sh_rest), sh_rest.shape[1] // 3
    directions = _directions()
    rotated_values, values = basis(directions @ rotation), basis(directions)  # the rows of d R are R^T d
    table = sh_rest.astype(np.float64).reshape(count, coefficients, 3)
    result, first = np.empty_like(table), 0
    for size in (3, 5, 7):
        if first + size > coefficients:
            break
        band = slice(first, first + size)
        matrix = np.linalg.lstsq(values[:, band], rotated_values[:, band], rcond=None)[0]
        result[:, band] = np.einsum("ij,njc->nic", matrix, table[:, band])
        first += size
    return result.reshape(count, 3 * coefficients)


def map_colors(coefficients: NDArray[np.floating], curve: Callable[[Floats], Floats]) -> Floats:
    """Apply a color curve to SH coefficients, [N, K, 3], by a least-squares fit over fixed directions.

    With band 0 only, the result is exact.
    """
    directions = _directions()
    values = basis(np.concatenate([directions, -directions]))[:, : coefficients.shape[1] - 1]
    values = np.concatenate([np.full((len(values), 1), BAND_0), values], axis=1)
    pseudo_inverse, result = np.linalg.pinv(values), np.empty(coefficients.shape)
    for first in range(0, len(coefficients), BLOCK_ROWS):
        rows = slice(first, first + BLOCK_ROWS)
        result[rows] = pseudo_inverse @ (curve(values @ coefficients[rows].astype(np.float64) + 0.5) - 0.5)
    return result


def _directions() -> NDArray[np.float64]:
    """Return fixed pseudo-random unit vectors, [DIRECTIONS, 3]."""
    vectors = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
