"""Define, read, override, explain and combine pipeline files."""
