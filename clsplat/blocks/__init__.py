"""A scene trained in blocks: a coarse model cut into cells, each trained from what its views see, and merged."""
