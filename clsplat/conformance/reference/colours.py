"""The colours of one photograph: an affine change of an image's colours, cut at white.

Images are [3, H, W]; a matrix is [3, 4], with the constant in its last column.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def coloured(image: NDArray[Any], matrix: NDArray[Any]) -> NDArray[Any]:
    """min(1, E c + b) of every pixel."""
    return np.minimum(_changed(image, matrix), 1)


def coloured_backward(
    image: NDArray[Any], matrix: NDArray[Any], gradient: NDArray[Any]
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Derivatives of sum(gradient * coloured) by the image and by the matrix; those of what is cut are 0."""
    passed = np.where(_changed(image, matrix) < 1, gradient, 0)
    by_image = np.einsum("ab,ahw->bhw", matrix[:, :3], passed)
    with_one = np.concatenate([image, np.ones((1, *image.shape[1:]))])
    return by_image, np.einsum("ahw,bhw->ab", passed, with_one)


def gain_matrix(exposure: float, red: float, blue: float) -> NDArray[Any]:
    """The matrix of a gain and a white balance, [3, 4]: green is tied, so that the luminance follows `exposure`."""
    luminance = np.array([0.299, 0.587, 0.114])  # BT.601
    green = -(luminance[0] * red + luminance[2] * blue) / luminance[1]
    return np.column_stack([np.diag(np.exp(exposure + np.array([red, green, blue]))), np.zeros(3)])


def gain_gradient(exposure: float, red: float, blue: float, grad_matrix: NDArray[Any]) -> NDArray[Any]:
    """Derivatives by exposure, red and blue, [3], from those by the matrix."""
    q = np.diag(grad_matrix) * np.diag(gain_matrix(exposure, red, blue))
    return np.array([q.sum(), q[0] - 0.299 / 0.587 * q[1], q[2] - 0.114 / 0.587 * q[1]])


def _changed(image: NDArray[Any], matrix: NDArray[Any]) -> NDArray[Any]:
    """E c + b of every pixel."""
    return np.asarray(np.einsum("ab,bhw->ahw", matrix[:, :3], image) + matrix[:, 3, None, None])
