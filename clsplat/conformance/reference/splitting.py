"""The splitting matrix (SteepGS, Wang et al. 2025): what becomes of the loss when a splat becomes two."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.reference.blending import alpha_gradients
from clsplat.conformance.reference.kinds import Camera, Gaussians, Splats, Thresholds


def screen_splitting(
    splats: Splats,
    width: int,
    height: int,
    background: NDArray[Any],
    grad_image: NDArray[Any],
    thresholds: Thresholds = Thresholds(),
) -> NDArray[Any]:
    """Σ dL/dalpha · (Hessian of alpha by the splat's mean) over pixels, one after another: [N,2,2] px⁻²."""
    found = np.zeros((len(splats.opacity), 2, 2))
    for step, grad_alpha in alpha_gradients(splats, width, height, background, grad_image, thresholds):
        a, b, c = splats.conic[step.splat]
        conic = np.array([[a, b], [b, c]])
        for row, column in np.argwhere(grad_alpha != 0):
            slope = conic @ [step.dx[row, column], step.dy[row, column]]
            hessian = step.alpha[row, column] * (np.outer(slope, slope) - conic)
            found[step.splat] += grad_alpha[row, column] * hessian
    return found


def mean_jacobian(camera: Camera, mean: NDArray[Any]) -> NDArray[Any]:
    """d(projected mean)/d(mean): [2,3] px by scene unit."""
    x, y, z = camera.rotation @ mean + camera.translation
    perspective = np.array([[camera.fx / z, 0, -camera.fx * x / z**2], [0, camera.fy / z, -camera.fy * y / z**2]])
    return perspective @ camera.rotation


def splitting(gaussians: Gaussians, camera: Camera, on_screen: NDArray[Any]) -> NDArray[Any]:
    """Lift matrices on the screen, [N,2,2], to the scene, with a form of the splat that stays: [N,3,3]."""
    found = np.zeros((len(on_screen), 3, 3))
    for n in np.flatnonzero(on_screen.any(axis=(1, 2))):
        jacobian = mean_jacobian(camera, gaussians.means[n])
        found[n] = jacobian.T @ on_screen[n] @ jacobian
    return found
