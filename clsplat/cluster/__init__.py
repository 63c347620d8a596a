"""Sweeps: cells, the store that holds them, and the engines that run them."""
