"""Density control: what views say about Gaussians, and rules by which they grow or go.  Each module adds its own."""

from clsplat.settings import import_modules

import_modules(__name__, __path__)
