"""Density control: statistics of Gaussians, edits, budgets, and scores shared by several rules."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
