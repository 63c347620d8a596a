"""What training minimises: losses that compare images, and penalties on Gaussians.  Each module adds its own."""

from clsplat.settings import import_modules

import_modules(__name__, __path__)
