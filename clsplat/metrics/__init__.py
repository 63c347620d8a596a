"""Image metrics.  `psnr` and `ssim` take two images; `evaluate` measures a model with them."""

from clsplat.metrics.images import psnr, ssim

__all__ = ["psnr", "ssim"]
