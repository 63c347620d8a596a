"""The names of the tables that hold Adam's moments."""


def moment_tables(parameter: str) -> tuple[str, str]:
    """Return the names of the tables that hold Adam's two moments of a parameter."""
    return f"adam/{parameter}/moment1", f"adam/{parameter}/moment2"


HARMONICS = ("sh_rest", *moment_tables("sh_rest"))  # above band 0: most of a Gaussian
