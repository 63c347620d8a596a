"""Runs of pipelines and matrices in their folders, and what is done with a finished one."""
