"""Create models from models: blocks, levels of detail, compression, further training."""
