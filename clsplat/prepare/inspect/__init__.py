"""The inspection of a dataset: facts, findings with remedies, and their page."""
