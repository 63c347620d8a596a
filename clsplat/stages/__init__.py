"""The stages of pipeline files: init, optimize, densify, evaluate, render, export, report and more."""

import clsplat.methods  # noqa: F401  defines rules and losses that stages refer to
from clsplat.core.settings import import_modules, rebuild_models
from clsplat.training import modules

import_modules(modules.__name__, modules.__path__)
import_modules(__name__, __path__)
rebuild_models()  # `optimize.during` now accepts every stage
