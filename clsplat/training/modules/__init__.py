"""Modules of a training step in addition to the Gaussians, each with its settings and its state in one file."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
