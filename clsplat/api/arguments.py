"""Convert arguments of the API to the forms that the rest of the package takes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError

PathLike = str | Path
Overrides = Mapping[str, Any] | Sequence[str]  # values by key, or 'key=value' as for --set


def overrides(values: Overrides) -> list[str]:
    """Return settings as for `--set`; paths become text, and NumPy numbers become numbers.

    Raises ConfigError for a value that YAML cannot hold.
    """
    if isinstance(values, str):
        return [values]
    if not isinstance(values, Mapping):
        return list(values)
    try:
        return [f"{key}={json.dumps(value, default=_plain)}" for key, value in values.items()]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"set: {error}; expected numbers, text, and lists or mappings of these") from None


def _plain(value: Any) -> Any:
    """Convert a value for JSON.  Raises TypeError."""
    import numpy as np  # slow to import, and the command line does not need it

    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")


def load_plugins() -> None:
    """Import the plug-ins of installed packages, once."""
    from importlib.metadata import entry_points

    if entry_points(group="clsplat.plugins"):  # without plug-ins, the command line starts without OpenCL and pydantic
        from clsplat.pipeline import plugins

        plugins.load_installed()


def path_of(value: PathLike | None) -> Path | None:
    """Return a path as a Path; None stays None."""
    return None if value is None else Path(value)


def layer_names(depth: bool, alpha: bool) -> tuple[str, ...]:
    """Return the names of the layers to render."""
    return ("color", *(name for name, wanted in (("depth", depth), ("alpha", alpha)) if wanted))
