"""Run many pipelines: the store of a sweep's cells, the engines that run them, and comparisons."""
