"""Methods of papers, a file each: density rules, losses and stages that only that method has."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
