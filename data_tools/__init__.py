"""Create, download, and convert datasets; only the command line imports this package."""
