"""Cameras of a scene in the files of other programs."""
