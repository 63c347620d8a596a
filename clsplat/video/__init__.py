"""Films of a model: camera paths, pictures of colour, depth and coverage, and files of video."""
