"""Create models from other models: train in blocks, build levels of detail, compress, and fine-tune."""
