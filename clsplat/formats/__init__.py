"""Splat files: a module for each format, and one table of them."""
