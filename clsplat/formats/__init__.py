"""Read and write splat files: one module per format, and `table`, which lists the formats."""
