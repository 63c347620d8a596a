"""Many runs: the matrix, the store of cells, the engines that run them, and comparisons."""
