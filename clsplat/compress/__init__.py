"""A model made as small as a target allows: prunings and quantisations, each measured as it is read back."""
