"""Methods from papers, one file each: the density rules, losses, and stages that only one method uses."""

from clsplat.core.settings import import_modules

import_modules(__name__, __path__)
