"""Datasets: made scenes, downloads, and conversions; only the command line imports it."""
