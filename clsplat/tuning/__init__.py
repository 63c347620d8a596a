"""A model trained further, in a folder of its own, and measured; `compress`, `lod` and `blocks` do that."""
