"""Check that a device computes correctly and measure its speed, with a float64 reference, doctor and bench."""
