"""Define, read, override, and combine pipeline files, and explain their errors."""
