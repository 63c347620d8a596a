"""Make videos of a model: camera paths, views along them, and encoding."""
