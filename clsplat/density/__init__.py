"""Density control: statistics of Gaussians, edits, budgets, and the scores that several rules share."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
