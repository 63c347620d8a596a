"""Targets of a training step: photographs on the device, their sampling and transforms."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
