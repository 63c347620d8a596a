"""Images of Gaussians: tile lists, projection, blending, filters, backgrounds."""
