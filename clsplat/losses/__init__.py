"""Losses that compare images, and penalties on Gaussians.  Each module defines its own variants."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
