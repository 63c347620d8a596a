"""What a training step compares with: which view, at which size, and its photograph on the device."""

from clsplat.settings import import_modules

import_modules(__name__, __path__)
