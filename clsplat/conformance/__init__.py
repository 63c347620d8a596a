"""Is a device right, and how fast: the float64 reference, the checks, doctor and bench."""
