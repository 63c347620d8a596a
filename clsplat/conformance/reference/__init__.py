"""The reference: 3D Gaussian splatting and its gradients in float64 NumPy, written to be read, not to be fast.

Kerbl et al. 2023 (3DGS), with the filters of Yu et al. 2024 (Mip-Splatting).

Conventions: OpenCV camera (x right, y down, z forward); the centre of pixel (0, 0) is (0.5, 0.5); quaternions are
(w, x, y, z); `grad_x` is dL/dx.  Letters: N Gaussians, K harmonics, C = 3 channels, H, W image.
"""

from clsplat.conformance.reference.adam import (
    adam_step,
)
from clsplat.conformance.reference.blending import (
    blend,
    blend_backward,
    blend_steps,
    blend_weights,
    contribution,
    falloff_squares,
    margin,
    render,
    render_backward,
    weight_entropy,
)
from clsplat.conformance.reference.blur import (
    blurred,
)
from clsplat.conformance.reference.clusters import member_sums, nearest_vectors, shared_means
from clsplat.conformance.reference.colour_grid import centred_grids, grid_smoothness, gridded, gridded_backward
from clsplat.conformance.reference.colours import coloured, coloured_backward, gain_gradient, gain_matrix
from clsplat.conformance.reference.density import (
    ABSGS,
    CLONE,
    KEEP,
    PRUNE,
    SPLIT,
    adc_actions,
    decayed_logit,
    mean_gradient,
    reset_logit,
    screen_gain,
    screen_gradient,
    shared_logit,
    split_children,
)
from clsplat.conformance.reference.haar import (
    haar_filtered,
    haar_gradient,
)
from clsplat.conformance.reference.harmonics import (
    sh_basis,
    sh_basis_gradient,
)
from clsplat.conformance.reference.inverse_depth import inverse_depth, inverse_depth_backward, inverse_depth_loss
from clsplat.conformance.reference.kinds import (
    SMOOTH,
    Camera,
    Gaussians,
    Splats,
    Thresholds,
)
from clsplat.conformance.reference.layer import gradient_behind, laid_over, layer_cover
from clsplat.conformance.reference.losses import (
    dssim,
    l1,
    l2,
    ms_ssim,
    psnr,
    ssim_map,
    ssim_taps,
    view_error,
)
from clsplat.conformance.reference.motion import brevity, moved, moved_backward, travel
from clsplat.conformance.reference.penalties import (
    anisotropy,
    covariance_trace,
    mean_opacity,
    mean_scale,
)
from clsplat.conformance.reference.poses import moved_camera, pose_gradient
from clsplat.conformance.reference.projection import (
    clamped_ray,
    footprint,
    project,
    ray_limits,
    rotation_matrix,
)
from clsplat.conformance.reference.projection_backward import (
    project_backward,
    ratio_gradient,
)
from clsplat.conformance.reference.random import dropped, normal3, philox
from clsplat.conformance.reference.sky import rays, shows_sky, sky_cover, sky_gradient, sky_image, sky_update
from clsplat.conformance.reference.splitting import mean_jacobian, screen_splitting, splitting
from clsplat.conformance.reference.transients import residual_numbers, residuals, without_transients
from clsplat.conformance.reference.world_filter import (
    filtered,
    sampling_interval,
)

__all__ = [
    "ABSGS",
    "CLONE",
    "KEEP",
    "PRUNE",
    "SMOOTH",
    "SPLIT",
    "Camera",
    "Gaussians",
    "Splats",
    "Thresholds",
    "adam_step",
    "adc_actions",
    "anisotropy",
    "blend",
    "blend_backward",
    "blend_steps",
    "blend_weights",
    "blurred",
    "brevity",
    "centred_grids",
    "clamped_ray",
    "coloured",
    "coloured_backward",
    "contribution",
    "covariance_trace",
    "decayed_logit",
    "dropped",
    "dssim",
    "falloff_squares",
    "filtered",
    "footprint",
    "gain_gradient",
    "gain_matrix",
    "gradient_behind",
    "grid_smoothness",
    "gridded",
    "gridded_backward",
    "haar_filtered",
    "haar_gradient",
    "inverse_depth",
    "inverse_depth_backward",
    "inverse_depth_loss",
    "l1",
    "l2",
    "laid_over",
    "layer_cover",
    "margin",
    "mean_gradient",
    "mean_jacobian",
    "mean_opacity",
    "mean_scale",
    "member_sums",
    "moved",
    "moved_backward",
    "moved_camera",
    "ms_ssim",
    "nearest_vectors",
    "normal3",
    "philox",
    "pose_gradient",
    "project",
    "project_backward",
    "psnr",
    "ratio_gradient",
    "ray_limits",
    "rays",
    "render",
    "render_backward",
    "reset_logit",
    "residual_numbers",
    "residuals",
    "rotation_matrix",
    "sampling_interval",
    "screen_gain",
    "screen_gradient",
    "screen_splitting",
    "sh_basis",
    "sh_basis_gradient",
    "shared_logit",
    "shared_means",
    "shows_sky",
    "sky_cover",
    "sky_gradient",
    "sky_image",
    "sky_update",
    "split_children",
    "splitting",
    "ssim_map",
    "ssim_taps",
    "travel",
    "view_error",
    "weight_entropy",
    "without_transients",
]
