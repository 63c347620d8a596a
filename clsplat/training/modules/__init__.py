"""What takes part in a training step next to the Gaussians: one file a module, with its settings and its state."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
