"""Render images of Gaussians: tile lists, projection, blending, filters, and backgrounds."""
