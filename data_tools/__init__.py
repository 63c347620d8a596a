"""Create, download, and convert datasets.  Only the command line imports this package."""
