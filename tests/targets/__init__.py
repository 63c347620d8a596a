"""What compilers for GPUs say about every kernel, without a GPU: `python -m tests.targets`."""
