"""Density control: statistics of Gaussians, edits, budgets, and what rules share.  Each module defines variants."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
