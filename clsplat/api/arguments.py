"""What the functions of the API take, in the forms that the rooms below take."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError

PathLike = str | Path
Overrides = Mapping[str, Any] | Sequence[str]  # values by place, or 'place=value' as --set takes it


def overrides(values: Overrides) -> list[str]:
    """Return settings as `--set` takes them; paths and numbers of NumPy count as text and numbers.

    Raises ConfigError for a value that YAML cannot hold.
    """
    if isinstance(values, str):
        return [values]
    if not isinstance(values, Mapping):
        return list(values)
    try:
        return [f"{place}={json.dumps(value, default=_plain)}" for place, value in values.items()]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"set: {error}; expected numbers, text, and lists and mappings of them") from None


def _plain(value: Any) -> Any:
    """A value that JSON does not know as one that it does.  Raises TypeError."""
    import numpy as np  # only where it is needed: the command line starts without it

    if isinstance(value, Path):
        return str(value)
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"Object of type {type(value).__name__} is not JSON serializable")


def load_plugins() -> None:
    """Import the plug-ins of installed packages, once."""
    from importlib.metadata import entry_points

    if entry_points(group="clsplat.plugins"):  # without any, the command line starts without OpenCL and pydantic
        from clsplat.pipeline import plugins

        plugins.load_installed()


def path_of(value: PathLike | None) -> Path | None:
    """Return a path as one."""
    return None if value is None else Path(value)


def layer_names(depth: bool, alpha: bool) -> tuple[str, ...]:
    """Return the layers that are rendered."""
    return ("color", *(name for name, wanted in (("depth", depth), ("alpha", alpha)) if wanted))
