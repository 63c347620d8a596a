"""The stages of pipeline files.  Each module defines stages."""

from clsplat.settings import import_modules, rebuild

import_modules(__name__, __path__)
rebuild()  # `optimize.during` now accepts every stage
