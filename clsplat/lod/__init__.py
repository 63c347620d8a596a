"""Levels of detail: a model with fewer and fewer Gaussians, trained where photographs are there, and streamed."""
