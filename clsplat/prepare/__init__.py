"""From a folder of photographs to a scene, in steps whose results are kept."""
