"""The image metrics `psnr` and `ssim`.  `clsplat.evaluate` measures a model with them."""

from clsplat.metrics.images import psnr, ssim

__all__ = ["psnr", "ssim"]
