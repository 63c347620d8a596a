"""Compute 3D Gaussian splatting and its gradients in float64 with NumPy.  The code is simple, but slow.

The formulas are those of Kerbl et al. 2023 (3DGS), with the filters of Yu et al. 2024 (Mip-Splatting).

Conventions: OpenCV camera (x right, y down, z forward); the center of pixel (0, 0) is (0.5, 0.5); quaternions are
(w, x, y, z); `grad_x` is dL/dx.  Sizes: N Gaussians, K SH coefficients, C = 3 channels, H x W pixels.
"""

from clsplat.conformance.reference.appearance import *
from clsplat.conformance.reference.blending import *
from clsplat.conformance.reference.images import *
from clsplat.conformance.reference.motion import *
from clsplat.conformance.reference.projection import *
from clsplat.conformance.reference.random import *
from clsplat.conformance.reference.sky import *
from clsplat.conformance.reference.training import *
from clsplat.conformance.reference.types import *
