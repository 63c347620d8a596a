"""Modules that take part in a training step next to the Gaussians: one file each, with settings and state."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
