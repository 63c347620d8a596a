"""Inspect datasets: measure their properties, derive findings with remedies, and write a page."""
