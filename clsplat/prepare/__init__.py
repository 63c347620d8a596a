"""From a folder of photographs to a scene: steps whose results are kept."""
