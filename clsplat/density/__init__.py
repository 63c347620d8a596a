"""Density control: statistics of Gaussians, and rules that add and remove them.  Each module defines variants."""

from clsplat.settings import import_modules

import_modules(__name__, __path__)
