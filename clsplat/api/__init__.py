"""The Python API: thin objects over the packages below, NumPy in and out.  `import clsplat` offers the names."""
