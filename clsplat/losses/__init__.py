"""Losses on images, and penalties on Gaussians, one topic per module."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
