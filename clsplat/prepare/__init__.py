"""Convert photographs to a scene (features, matches, mapping, undistortion), and inspect datasets."""
