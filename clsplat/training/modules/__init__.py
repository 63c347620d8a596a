"""What a training step learns or knows of each photograph besides the Gaussians, a file each."""
