"""Measure the time of training steps, and compare it with the peaks of the device."""
