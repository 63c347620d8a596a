"""A model trained further from its photographs, in a folder of its own, and measured; `compress` and `lod` do that."""
