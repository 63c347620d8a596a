"""The sample of a training step: a view, its size, and its photograph on the device."""

from clsplat.settings import import_modules

import_modules(__name__, __path__)
