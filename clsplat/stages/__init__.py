"""The stages that a pipeline file can name.  Each module adds its own."""

from clsplat.settings import import_modules, rebuild

import_modules(__name__, __path__)
rebuild()  # `optimize.during` knows every stage
