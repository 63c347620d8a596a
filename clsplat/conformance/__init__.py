"""Check the results of a device against a float64 reference (doctor), and measure its speed (bench)."""
