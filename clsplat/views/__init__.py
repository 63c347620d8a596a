"""What a training step compares with: which view, at which size, and its photograph on the device."""
