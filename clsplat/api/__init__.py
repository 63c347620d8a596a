"""What researchers call: thin objects over the rooms below, NumPy in and out.  `import clsplat` offers the names."""
