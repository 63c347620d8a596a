"""Gaussians: their tables on the device, models on the host, and conversions of models."""
