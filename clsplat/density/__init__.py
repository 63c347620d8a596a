"""Density control: statistics of Gaussians, edits, budgets, and scores that rules share."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
