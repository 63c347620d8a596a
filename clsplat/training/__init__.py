"""Training: the step, Adam, training modules, the base of stages, checkpoints, the memory plan."""
