"""Pipeline files: what they can say, how they are read, overridden, explained and combined."""
