"""Photographs to a scene: features, matches, mapping, undistortion; and the inspection of datasets."""
