"""Losses, rules, filters, stages, readers and more from outside the package.

A plug-in is a Python file, given by `--plugin FILE.py`, or a module that an installed package names in the entry-point
group `clsplat.plugins`.  Its classes can be used after its import; kernels lie beside it and may include the headers
of `cl_kernels`.  A run records the name and the content hash of each of its plug-ins.
"""

import ast
import importlib.util
import re
import sys
import traceback
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

import clsplat.pipeline.file  # noqa: F401  defines all settings of the package
from clsplat.core.errors import PLUGIN_MARK, ClsplatError, ConfigError
from clsplat.core.reading import read_file
from clsplat.core.settings import Settings, invalid_variant_reason, rebuild_models
from clsplat.scene.detect import readers
from clsplat.scene.reader import Reader

GROUP = "clsplat.plugins"
_KERNEL_FILE = re.compile(r"[\w-]+\.(?:cl|h)\b")
_loaded: dict[str, "Plugin"] = {}  # by name


@dataclass(frozen=True)
class Plugin:
    """One module from outside the package."""

    name: str  # of the file without .py, or of the entry point
    path: Path
    digest: str  # sha256 of its Python files, of the kernel files that they name, and of their headers
    installed: bool  # by a package, and not by --plugin
    kinds: tuple[type, ...]  # its settings and readers


def load_file(path: Path) -> Plugin:
    """Import a plug-in.  Raises ConfigError, with file and line, when that fails or its name is taken."""
    path = path.resolve()
    if not path.is_file():
        raise ConfigError(f"--plugin {path}: no such file; expected a Python file")
    name = f"clsplat_plugin_{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}"
    if (before := _loaded.get(path.stem)) is not None:
        if before.path != path:
            raise ConfigError(
                f"--plugin {path}: a plug-in named '{path.stem}' is loaded from {before.path}; rename the file"
            )
        if before.digest != digest_of(path, *_helpers(sys.modules[name], path.parent)):
            raise ConfigError(f"--plugin {path}: its files have changed since it was loaded; restart Python")
        return before
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"--plugin {path}: expected a Python file with the suffix .py")
    with _importing(name, path) as kinds:
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    digest = digest_of(path, *_helpers(module, path.parent))
    _loaded[path.stem] = Plugin(path.stem, path, digest, installed=False, kinds=tuple(kinds))
    return _loaded[path.stem]


def load_installed() -> None:
    """Import the plug-ins of installed packages, once.  Raises ConfigError when one fails."""
    for entry in entry_points(group=GROUP):
        if entry.name not in _loaded:
            _loaded[entry.name] = _load_entry(entry)


def loaded() -> list[Plugin]:
    """Return the plug-ins that are imported."""
    return list(_loaded.values())


def used_by(kinds: Collection[type]) -> dict[str, str]:
    """Return name and content hash of the plug-ins of a run with settings of these classes.

    They are those given by a file, those of the classes or of their bases, and each installed one that defines a
    reader: a run may be checked before its scene is known.
    """
    bases = {base for kind in kinds for base in kind.__mro__}
    return {
        plugin.name: plugin.digest
        for plugin in loaded()
        if not plugin.installed or any(kind in bases or not issubclass(kind, Settings) for kind in plugin.kinds)
    }


def require(recorded: Mapping[str, str], where: str) -> None:
    """Raise ConfigError when a recorded plug-in is missing or has other content now; `where` names the record."""
    if faults := differences(recorded):
        raise ConfigError(f"{where}: {faults[0]}")


def differences(recorded: Mapping[str, str]) -> list[str]:
    """Return a sentence for each recorded plug-in that is not loaded or has other content now."""
    faults = []
    for name, digest in recorded.items():
        if name not in _loaded:
            faults.append(f"needs the plug-in '{name}', which is not loaded; use --plugin {name}.py")
        elif _loaded[name].digest != digest:
            here = f"{_loaded[name].path} has sha256 {_loaded[name].digest[:12]}"
            faults.append(f"needs the plug-in '{name}' with sha256 {digest[:12]}, {here}; use the file as it was")
    return faults


def digest_of(*modules: Path) -> str:
    """Return the sha256 of Python files, and of the kernel files and headers beside them that they and those name."""
    digest, waiting = sha256(), list(dict.fromkeys(modules))
    seen = set(waiting)
    while waiting:
        file = waiting.pop(0)
        content = read_file(file, "a file of a plug-in", ConfigError)
        digest.update(f"{file.name}\n{len(content)}\n".encode() + content)
        named = {file.parent / name for name in _KERNEL_FILE.findall(content.decode("utf-8", "replace"))}
        named |= {file.with_suffix(".cl")} if file in modules else set()
        found = sorted(one for one in named if one not in seen and one.is_file())
        waiting += found
        seen.update(found)
    return digest.hexdigest()


def _load_entry(entry: EntryPoint) -> Plugin:
    with _importing(entry.module) as kinds:
        module = importlib.import_module(entry.module)
        package = _package_of(module)
        path = Path(module.__file__ or entry.module)
        files = sorted(path for folder in getattr(package, "__path__", ()) for path in Path(folder).rglob("*.py"))
        digest = digest_of(path, *files)
    earlier = [kind for kind in _defined() if _within(kind.__module__, package.__name__)]  # imported by others
    return Plugin(entry.name, path, digest, installed=True, kinds=tuple(dict.fromkeys([*kinds, *earlier])))


@contextmanager
def _importing(module: str, path: Path | None = None) -> Iterator[list[type]]:
    """Yield a list, filled at the end with the classes that the block defines.

    When the block fails, or when a class has the name of another, forget all that the block defined and raise
    ConfigError; whatever a module can raise is caught, but for KeyboardInterrupt.
    """
    kinds: list[type] = []
    lists = _lists()  # with everything of the package, so that what the block adds is the plug-in's
    before, modules = [list(known) for known in lists], set(sys.modules)
    try:
        with redirect_stdout(sys.stderr):  # standard output is for results
            yield kinds
        added = [kind for known, old in zip(lists, before, strict=True) for kind in known if kind not in old]
        kinds += [kind for kind in added if not _within(kind.__module__, "clsplat")]
        rebuild_models()
        readers()
        for kind in kinds:
            setattr(sys.modules[kind.__module__], PLUGIN_MARK, True)
            if issubclass(kind, Settings) and (fault := invalid_variant_reason(kind)):
                raise ConfigError(f"class {kind.__name__}: {fault}")
    except BaseException as error:
        place = _place(module, path, error)
        new = {kind.__module__ for known, old in zip(lists, before, strict=True) for kind in known if kind not in old}
        for name in set(sys.modules) - modules:
            if name in new or _within(name, module.partition(".")[0]):
                del sys.modules[name]
        for known, old in zip(lists, before, strict=True):
            known[:] = [kind for kind in known if kind in old or _within(kind.__module__, "clsplat")]
        rebuild_models()
        if isinstance(error, KeyboardInterrupt):
            raise
        raise _failure(place, error) from error


def _lists() -> tuple[list[type], list[type]]:
    """The lists of all settings and of all readers; importing `clsplat.pipeline.file` has filled them."""
    return Settings.defined, Reader.defined


def _defined() -> list[type]:
    return [kind for known in _lists() for kind in known]


def _within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def _package_of(module: ModuleType) -> ModuleType:
    """The outermost package of a module that is no namespace; a module without a package itself."""
    parts = module.__name__.split(".")
    around = [sys.modules[".".join(parts[:i])] for i in range(1, len(parts) + 1)]
    return next((one for one in around if one.__file__), module)


def _helpers(module: ModuleType, folder: Path) -> list[Path]:
    """The files of a folder that a module imports, and those that they import, whoever imported them first."""
    waiting, found = [module], dict[Path, None]()
    while waiting:
        for helper in _imports(waiting.pop()):
            file = Path(helper.__file__ or "").resolve()
            own = file.suffix == ".py" and file.is_relative_to(folder) and "site-packages" not in file.parts
            if own and file not in found and helper.__name__.partition(".")[0] != "clsplat":
                found[file] = None
                waiting.append(helper)
    return sorted(found)


def _imports(module: ModuleType) -> list[ModuleType]:
    """The modules that the import statements of a module name."""
    names: list[str] = []
    for node in ast.walk(ast.parse(read_file(Path(module.__file__ or ""), kind=ConfigError))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(relative, module.__package__ or "")
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    parts = [name.split(".") for name in names]
    every = dict.fromkeys(".".join(one[:i]) for one in parts for i in range(1, len(one) + 1))
    return [sys.modules[name] for name in every if getattr(sys.modules.get(name), "__file__", None)]


def _place(module: str, path: Path | None, error: BaseException) -> str:
    """File and line where a plug-in fails: the last line of its own, or else the last outside the import system."""
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).is_file():
        return f"{error.filename}:{error.lineno}"
    frames = [
        (str(frame.f_globals.get("__name__")), frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
    ]
    frames = [one for one in frames if "importlib" not in one[0] and one[0] not in (__name__, "contextlib")]
    own = [
        (file, line)
        for name, file, line in frames
        if _within(name, module.partition(".")[0]) or (path and Path(file).is_relative_to(path.parent))
    ]
    if own or (frames and not isinstance(error, ClsplatError)):
        file, line = own[-1] if own else frames[-1][1:]
        return f"{file}:{line}"
    return str(path or getattr(sys.modules.get(module), "__file__", None) or module)


def _failure(place: str, error: BaseException) -> ConfigError:
    """The error in one line: file, line and reason."""
    if isinstance(error, ClsplatError):
        return ConfigError(f"{place}: {error}")
    reason = error.msg if isinstance(error, SyntaxError) else " ".join(str(error).split()) or "no message"
    return ConfigError(f"{place}: the plug-in cannot be imported: {type(error).__name__}: {reason[:300]}")
