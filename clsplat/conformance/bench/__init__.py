"""Measure the time of training steps, and compare it with the device's peak throughput."""
