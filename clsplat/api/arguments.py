"""Convert the arguments of the API to the types that the other packages use."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError

PathLike = str | Path
Overrides = Mapping[str, Any] | Sequence[str]  # settings by key, or 'key=value' strings as for --set


def overrides(values: Overrides) -> list[str]:
    """Return settings as `key=value` strings, the notation of `--set`.  Paths and NumPy scalars are converted.

    Raises ConfigError for a value that YAML cannot represent.
    """
    if isinstance(values, str):
        return [values]
    if not isinstance(values, Mapping):
        return list(values)
    try:
        return [f"{key}={json.dumps(value, default=_plain)}" for key, value in values.items()]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"set: {error}; expected numbers, strings, lists, or mappings") from None


def _plain(value: Any) -> Any:
    """Convert a path to a string, or a NumPy scalar to a number.  Raises TypeError for other types."""
    import numpy as np  # slow to import, and the command line does not need it

    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")


def load_plugins() -> None:
    """Import the plug-ins of installed packages.  Only the first call has an effect."""
    from importlib.metadata import entry_points

    if entry_points(group="clsplat.plugins"):  # otherwise the command line starts without OpenCL and pydantic
        from clsplat.pipeline import plugins

        plugins.load_installed()


def to_path(value: PathLike | None) -> Path | None:
    """Convert a path to `Path`, and return None for None."""
    return None if value is None else Path(value)


def layer_names(depth: bool | str, normals: bool, alpha: bool) -> tuple[str, ...]:
    """Return the names of the layers to render: "color", and others if requested.  Raises ConfigError.

    depth: True or "mean" for the mean depth; "median" for the median depth
    """
    depths = {False: None, True: "depth", "mean": "depth", "median": "median_depth"}
    if depth not in depths:
        raise ConfigError(f"depth: expected mean or median, got '{depth}'")
    layers = {depths[depth]: True, "normals": normals, "alpha": alpha}
    return ("color", *(name for name, is_requested in layers.items() if name and is_requested))
