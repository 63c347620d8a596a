"""Training modules, which extend a training step; each file contains the settings and the state of one module."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
