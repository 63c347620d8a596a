"""Videos of a model: camera paths, the views along them, and encoding."""
