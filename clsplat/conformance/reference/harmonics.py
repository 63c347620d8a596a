"""Spherical harmonics up to degree 3 in the sign convention of 3DGS, and their derivatives."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def _harmonics(x: NDArray[Any], y: NDArray[Any], z: NDArray[Any]) -> list[tuple[Any, ...]]:
    """The 16 rows (value, d/dx, d/dy, d/dz), treating x, y, z as free."""
    c0, c1 = 0.28209479177387814, 0.4886025119029199
    a, b, c = 1.0925484305920792, 0.31539156525252005, 0.5462742152960396
    d, e, f = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
    g, h = 0.3731763325901154, 1.445305721320277
    xx, yy, zz = x * x, y * y, z * z
    return [
        (c0, 0, 0, 0),
        (-c1 * y, 0, -c1, 0),
        (c1 * z, 0, 0, c1),
        (-c1 * x, -c1, 0, 0),
        (a * x * y, a * y, a * x, 0),
        (-a * y * z, 0, -a * z, -a * y),
        (b * (2 * zz - xx - yy), -2 * b * x, -2 * b * y, 4 * b * z),
        (-a * x * z, -a * z, 0, -a * x),
        (c * (xx - yy), 2 * c * x, -2 * c * y, 0),
        (-d * y * (3 * xx - yy), -6 * d * x * y, -3 * d * (xx - yy), 0),
        (e * x * y * z, e * y * z, e * x * z, e * x * y),
        (-f * y * (4 * zz - xx - yy), 2 * f * x * y, -f * (4 * zz - xx - 3 * yy), -8 * f * y * z),
        (g * z * (2 * zz - 3 * xx - 3 * yy), -6 * g * x * z, -6 * g * y * z, g * (6 * zz - 3 * xx - 3 * yy)),
        (-f * x * (4 * zz - xx - yy), -f * (4 * zz - 3 * xx - yy), 2 * f * x * y, -8 * f * x * z),
        (h * z * (xx - yy), 2 * h * x * z, -2 * h * y * z, h * (xx - yy)),
        (-d * x * (xx - 3 * yy), -3 * d * (xx - yy), 6 * d * x * y, 0),
    ]


def _harmonic_table(directions: NDArray[Any], degree: int) -> NDArray[Any]:
    """Value and gradient of the first (degree+1)² harmonics: [..., K, 4]."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    table = np.empty((*x.shape, (degree + 1) ** 2, 4))
    for k, row in enumerate(_harmonics(x, y, z)[: (degree + 1) ** 2]):
        for i, entry in enumerate(row):
            table[..., k, i] = entry
    return table


def sh_basis(directions: NDArray[Any], degree: int) -> NDArray[Any]:
    """Y_k of unit directions: [..., 3] -> [..., K]."""
    return _harmonic_table(directions, degree)[..., 0]


def sh_basis_gradient(directions: NDArray[Any], degree: int) -> NDArray[Any]:
    """dY_k/d(x, y, z), as polynomials of free x, y, z: [..., 3] -> [..., K, 3]."""
    return _harmonic_table(directions, degree)[..., 1:]
