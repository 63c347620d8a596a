"""Inspect datasets: measure facts, derive findings with remedies, and write a page."""
