"""Define the inputs and outputs of the reference."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PARAMETERS = ("means", "quats", "log_scales", "logit_opacity", "sh")
RADIUS_TILE = 16  # px, tile of the original visibility test; kernels may use other tiles


@dataclass(frozen=True)
class Thresholds:
    """The thresholds of blending (Kerbl et al. 2023); SMOOTH_THRESHOLDS skip no splat, so images are differentiable."""

    alpha_min: float = 1 / 255
    alpha_max: float = 0.99
    transmittance_min: float = 1e-4


SMOOTH_THRESHOLDS = Thresholds(alpha_min=0.0, transmittance_min=0.0)


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera; `fx, fy, cx, cy` are in px."""

    world_to_camera: NDArray[Any]  # [3,4]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def rotation(self) -> NDArray[Any]:
        return self.world_to_camera[:, :3]

    @property
    def translation(self) -> NDArray[Any]:
        return self.world_to_camera[:, 3]

    @property
    def position(self) -> NDArray[Any]:
        return -self.rotation.T @ self.translation


@dataclass
class RawGaussians:
    """Trained parameters, before activations."""

    means: NDArray[Any]  # [N,3]
    quats: NDArray[Any]  # [N,4] w, x, y, z; not normalized
    log_scales: NDArray[Any]  # [N,3]
    logit_opacity: NDArray[Any]  # [N]
    sh: NDArray[Any]  # [N,K,3]
    filter_variance: NDArray[Any] = field(default_factory=lambda: np.zeros(0))  # [N] scene units²; default: zeros
    opacity_factor: float = 1.0  # factor on all opacities, from a step's dropout

    def __post_init__(self) -> None:
        if len(self.filter_variance) == 0:
            self.filter_variance = np.zeros(len(self.means))
        for name in (*PARAMETERS, "filter_variance"):
            setattr(self, name, np.array(getattr(self, name), np.float64))


@dataclass
class Splats:
    """Projected Gaussians.  Rows that are not visible are zero, but may have a radius."""

    mean2d: NDArray[Any]  # [N,2] px
    conic: NDArray[Any]  # [N,3] A, B, C = xx, xy, yy of the inverse covariance; of the covariance if `pixel_box`
    opacity: NDArray[Any]  # [N] after both filters
    color: NDArray[Any]  # [N,3]
    depth: NDArray[Any]  # [N] z
    radius: NDArray[Any]  # [N] px, an integer, independent of opacity; 0: not visible to density control
    visible: NDArray[Any]  # [N] bool: blended
    pixel_box: bool = False  # whether splats are integrated over each pixel's box (blending.py)


class SplatGradients(NamedTuple):
    """The gradients of a loss with respect to the values of projected Gaussians."""

    mean2d: NDArray[Any]  # [N,2]
    conic: NDArray[Any]  # [N,3] with respect to the scalars of Splats.conic
    opacity: NDArray[Any]  # [N]
    color: NDArray[Any]  # [N,3]
    mean2d_abs: NDArray[Any]  # [N,2] sum over pixels of |dL/du|, |dL/dv|
