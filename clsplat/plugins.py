"""Losses, rules, filters, stages, readers and more from outside the package.

A plug-in is a Python file, given by `--plugin FILE.py`, or a module that an installed package names in the entry-point
group `clsplat.plugins`.  Its classes can be used after its import; kernels lie beside it and may include the headers
of `cl_kernels`.  A run records the name and the content hash of each of its plug-ins.
"""

import hashlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from pydantic import BaseModel

from clsplat.errors import ClsplatError, ConfigError
from clsplat.settings import Settings, rebuild

GROUP = "clsplat.plugins"
_KERNEL_FILE = re.compile(r"[\w-]+\.(?:cl|h)\b")
_loaded: dict[str, "Plugin"] = {}  # by name


@dataclass(frozen=True)
class Plugin:
    """One module from outside the package."""

    name: str  # of the file without .py, or of the entry point
    path: Path
    module: str
    digest: str  # sha256 of the module, of the kernel files that it names, and of their headers
    installed: bool  # by a package, and not by --plugin


def load_file(path: Path) -> Plugin:
    """Import a plug-in.  Raises ConfigError, with file and line, when that fails or its name is taken."""
    path = path.resolve()
    if not path.is_file():
        raise ConfigError(f"--plugin {path}: no such file; expected a Python file")
    module = f"clsplat_plugin_{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}"
    plugin = Plugin(path.stem, path, module, digest_of(path), installed=False)
    if (before := _loaded.get(plugin.name)) is not None:
        if before == plugin:
            return before
        raise ConfigError(
            f"--plugin {path}: a plug-in named '{plugin.name}' is loaded from {before.path}; rename the file"
        )
    spec = importlib.util.spec_from_file_location(module, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"--plugin {path}: expected a Python file with the suffix .py")
    sys.modules[module] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(sys.modules[module])
        rebuild()
    except Exception as error:
        _forget(module)
        raise _failure(path, error) from error
    _loaded[plugin.name] = plugin
    return plugin


def load_installed() -> None:
    """Import the plug-ins of installed packages, once.  Raises ConfigError when one fails."""
    for entry in entry_points(group=GROUP):
        if entry.name not in _loaded:
            _loaded[entry.name] = _load_entry(entry)


def loaded() -> list[Plugin]:
    """Return the plug-ins that are imported."""
    return list(_loaded.values())


def used_by(settings: BaseModel) -> dict[str, str]:
    """Return name and content hash of a run's plug-ins: those given by a file, and those its settings come from."""
    modules = _modules(settings)
    return {p.name: p.digest for p in loaded() if not p.installed or any(m.startswith(p.module) for m in modules)}


def require(recorded: Mapping[str, str], where: str) -> None:
    """Raise ConfigError when a recorded plug-in is missing or has other content now; `where` names the record."""
    if faults := differences(recorded):
        raise ConfigError(f"{where}: {faults[0]}")


def differences(recorded: Mapping[str, str]) -> list[str]:
    """Return a sentence for each recorded plug-in that is not loaded or has other content now."""
    faults = []
    for name, digest in recorded.items():
        if name not in _loaded:
            faults.append(f"needs the plug-in '{name}', which is not loaded; use --plugin {name}.py before the command")
        elif _loaded[name].digest != digest:
            here = f"{_loaded[name].path} has sha256 {_loaded[name].digest[:12]}"
            faults.append(f"needs the plug-in '{name}' with sha256 {digest[:12]}, {here}; use the file as it was")
    return faults


def digest_of(path: Path) -> str:
    """Return the sha256 of a file and of the kernel files and headers beside it that it names, and those name."""
    digest, waiting, seen = hashlib.sha256(), [path], {path}
    while waiting:
        file = waiting.pop(0)
        content = file.read_bytes()
        digest.update(f"{file.name}\n{len(content)}\n".encode() + content)
        named = {path.parent / name for name in _KERNEL_FILE.findall(content.decode("utf-8", "replace"))}
        found = sorted(one for one in {*named, path.with_suffix(".cl")} if one not in seen and one.is_file())
        waiting += found
        seen.update(found)
    return digest.hexdigest()


def _load_entry(entry: EntryPoint) -> Plugin:
    try:
        module = importlib.import_module(entry.module)
        rebuild()
    except Exception as error:
        _forget(entry.module)
        raise _failure(Path(entry.module), error) from error
    path = Path(module.__file__ or entry.module)
    return Plugin(entry.name, path, entry.module, digest_of(path), installed=True)


def _forget(module: str) -> None:
    """Remove all of a module whose import failed."""
    sys.modules.pop(module, None)
    Settings.defined[:] = [kind for kind in Settings.defined if kind.__module__ != module]


def _failure(path: Path, error: Exception) -> ConfigError:
    """The error in one line: file, line and reason."""
    if isinstance(error, ClsplatError):
        return ConfigError(f"{path}: {error}")
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
    reason = error.msg if isinstance(error, SyntaxError) else " ".join(str(error).split()) or "no message"
    place = f"{path}:{line}" if line else str(path)
    return ConfigError(f"{place}: the plug-in cannot be imported: {type(error).__name__}: {reason[:300]}")


def _modules(settings: object) -> set[str]:
    """The modules of all settings inside settings."""
    if isinstance(settings, BaseModel):
        inner = [getattr(settings, name) for name in type(settings).model_fields]
        return {type(settings).__module__, *(module for value in inner for module in _modules(value))}
    if isinstance(settings, list | tuple):
        return {module for value in settings for module in _modules(value)}
    return set()
