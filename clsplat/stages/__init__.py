"""The stages of pipeline files: init, optimize, densify, evaluate, render, export, report and more."""

import clsplat.methods  # noqa: F401  whose rules and losses stages name
from clsplat.core.settings import import_modules, rebuild

import_modules(__name__, __path__)
rebuild()  # `optimize.during` now accepts every stage
