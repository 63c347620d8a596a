"""Times of training steps next to the peaks of the device."""
