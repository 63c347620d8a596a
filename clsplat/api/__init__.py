"""The Python API, with NumPy arrays as inputs and outputs.  `import clsplat` provides its names."""
