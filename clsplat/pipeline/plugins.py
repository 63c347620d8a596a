"""Import plug-ins: losses, rules, filters, stages, readers, and other classes from outside the package.

A plug-in is a Python file, given by `--plugin FILE.py`, or a module that an installed package names in the entry-point
group `clsplat.plugins`.  Once it is imported, its classes can be used.  Its kernels are files next to it, which may
include the headers of `cl_kernels`.  A run records the name and the content hash of each plug-in that it uses.
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
    """A plug-in that has been imported."""

    name: str  # name of the file without .py, or of the entry point
    path: Path
    digest: str  # SHA-256 of its Python files, the kernel files that they name, and the headers of the kernels
    is_installed: bool  # from a package rather than --plugin
    classes: tuple[type, ...]  # its settings and readers


def load_file(path: Path) -> Plugin:
    """Import a plug-in from a Python file.  Raises ConfigError if that fails or its name is already in use."""
    path = path.resolve()
    if not path.is_file():
        raise ConfigError(f"--plugin {path}: no such file; expected a Python file")
    name = f"clsplat_plugin_{re.sub(r'[^0-9A-Za-z_]', '_', path.stem)}"
    if (plugin := _loaded.get(path.stem)) is not None:
        if plugin.path != path:
            raise ConfigError(
                f"--plugin {path}: another plug-in named '{path.stem}' is loaded, from {plugin.path}; rename the file"
            )
        if plugin.digest != hash_plugin_files(path, *_imported_files(sys.modules[name], path.parent)):
            raise ConfigError(f"--plugin {path}: its files have changed since it was loaded; restart Python")
        return plugin
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ConfigError(f"--plugin {path}: expected a Python file with the suffix .py")
    with _collect_classes(name, path) as classes:
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    digest = hash_plugin_files(path, *_imported_files(module, path.parent))
    _loaded[path.stem] = Plugin(path.stem, path, digest, is_installed=False, classes=tuple(classes))
    return _loaded[path.stem]


def load_installed() -> None:
    """Import the plug-ins of installed packages that are not yet imported.  Raises ConfigError if one fails."""
    for entry in entry_points(group=GROUP):
        if entry.name not in _loaded:
            _loaded[entry.name] = _load_entry(entry)


def loaded_plugins() -> list[Plugin]:
    """Return all imported plug-ins."""
    return list(_loaded.values())


def used_by(classes: Collection[type]) -> dict[str, str]:
    """Return the names and content hashes of the plug-ins that a run may use, given the classes of its settings.

    These are all plug-ins from files, and the installed plug-ins that define one of the classes or of their bases.
    Plug-ins with a reader are included, because a run may be checked before its scene is known.
    """
    bases = {base for cls in classes for base in cls.__mro__}
    return {
        plugin.name: plugin.digest
        for plugin in loaded_plugins()
        if not plugin.is_installed or any(cls in bases or not issubclass(cls, Settings) for cls in plugin.classes)
    }


def require(digests: Mapping[str, str], source: str) -> None:
    """Raise ConfigError if a recorded plug-in is not loaded or has changed.

    digests: content hashes by name of the plug-in.  source: the file that contains the hashes.
    """
    if faults := differences(digests):
        raise ConfigError(f"{source}: {faults[0]}")


def differences(digests: Mapping[str, str]) -> list[str]:
    """Return a sentence for each recorded plug-in that is not loaded or has changed."""
    faults = []
    for name, digest in digests.items():
        if name not in _loaded:
            faults.append(f"needs the plug-in '{name}', which is not loaded; use --plugin {name}.py")
        elif _loaded[name].digest != digest:
            path, new_digest = _loaded[name].path, _loaded[name].digest
            change = f"{path} has changed (sha256 {new_digest[:12]}, was {digest[:12]})"
            faults.append(f"needs the plug-in '{name}', but {change}; use the earlier file")
    return faults


def hash_plugin_files(*modules: Path) -> str:
    """Return the SHA-256 of Python files, and of the kernel files and headers next to them that they refer to."""
    digest, queue = sha256(), list(dict.fromkeys(modules))
    visited_files = set(queue)
    while queue:
        file = queue.pop(0)
        content = read_file(file, "a file of a plug-in", ConfigError)
        digest.update(f"{file.name}\n{len(content)}\n".encode() + content)
        references = {file.parent / name for name in _KERNEL_FILE.findall(content.decode("utf-8", "replace"))}
        references |= {file.with_suffix(".cl")} if file in modules else set()
        new_files = sorted(path for path in references if path not in visited_files and path.is_file())
        queue += new_files
        visited_files.update(new_files)
    return digest.hexdigest()


def _load_entry(entry: EntryPoint) -> Plugin:
    with _collect_classes(entry.module) as classes:
        module = importlib.import_module(entry.module)
        package = _root_package(module)
        path = Path(module.__file__ or entry.module)
        files = sorted(path for folder in getattr(package, "__path__", ()) for path in Path(folder).rglob("*.py"))
        digest = hash_plugin_files(path, *files)
    all_classes = [
        cls for registered in _class_lists() for cls in registered
    ]  # another plug-in may have imported the module
    package_classes = [cls for cls in all_classes if _is_within(cls.__module__, package.__name__)]
    return Plugin(
        entry.name, path, digest, is_installed=True, classes=tuple(dict.fromkeys([*classes, *package_classes]))
    )


@contextmanager
def _collect_classes(module: str, path: Path | None = None) -> Iterator[list[type]]:
    """Yield a list.  When the block ends, add the classes that it defined to the list.

    If the block fails or two classes have the same name, remove everything that the block defined, and raise
    ConfigError.  Every exception except KeyboardInterrupt is converted.
    """
    classes: list[type] = []
    lists = _class_lists()  # they already contain all classes of clsplat, so new ones belong to the plug-in
    old_lists, modules = [list(registered) for registered in lists], set(sys.modules)
    try:
        with redirect_stdout(sys.stderr):  # stdout is for results
            yield classes
        new_classes = [
            cls for registered, old in zip(lists, old_lists, strict=True) for cls in registered if cls not in old
        ]
        classes += [cls for cls in new_classes if not _is_within(cls.__module__, "clsplat")]
        rebuild_models()
        readers()
        for cls in classes:
            setattr(sys.modules[cls.__module__], PLUGIN_MARK, True)
            if issubclass(cls, Settings) and (fault := invalid_variant_reason(cls)):
                raise ConfigError(f"class {cls.__name__}: {fault}")
    except BaseException as error:
        location = _locate(module, path, error)
        new_classes = [
            cls for registered, old in zip(lists, old_lists, strict=True) for cls in registered if cls not in old
        ]
        new_modules = {cls.__module__ for cls in new_classes}
        for name in set(sys.modules) - modules:
            if name in new_modules or _is_within(name, module.partition(".")[0]):
                del sys.modules[name]
        for registered, old in zip(lists, old_lists, strict=True):
            registered[:] = [cls for cls in registered if cls in old or _is_within(cls.__module__, "clsplat")]
        rebuild_models()
        if isinstance(error, KeyboardInterrupt):
            raise
        raise _failure(location, error) from error


def _class_lists() -> tuple[list[type], list[type]]:
    """Return the lists of all settings and all readers; importing `clsplat.pipeline.file` fills them."""
    return Settings.subclasses, Reader.subclasses


def _is_within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def _root_package(module: ModuleType) -> ModuleType:
    """Return the outermost package of a module, except namespace packages, or the module itself."""
    parts = module.__name__.split(".")
    packages = [sys.modules[".".join(parts[:i])] for i in range(1, len(parts) + 1)]
    return next((package for package in packages if package.__file__), module)


def _imported_files(module: ModuleType, folder: Path) -> list[Path]:
    """Return the files in a folder that a module imports, directly or indirectly."""
    stack, files = [module], set[Path]()
    while stack:
        for helper in _imports(stack.pop()):
            file = Path(helper.__file__ or "").resolve()
            is_inside = file.suffix == ".py" and file.is_relative_to(folder) and "site-packages" not in file.parts
            if is_inside and file not in files and helper.__name__.partition(".")[0] != "clsplat":
                files.add(file)
                stack.append(helper)
    return sorted(files)


def _imports(module: ModuleType) -> list[ModuleType]:
    """Return the modules that the import statements in a module refer to."""
    names: list[str] = []
    for node in ast.walk(ast.parse(read_file(Path(module.__file__ or ""), error_type=ConfigError))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            base = importlib.util.resolve_name(relative, module.__package__ or "")
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    parts = [name.split(".") for name in names]
    prefixes = dict.fromkeys(".".join(path[:i]) for path in parts for i in range(1, len(path) + 1))
    return [sys.modules[name] for name in prefixes if getattr(sys.modules.get(name), "__file__", None)]


def _locate(module: str, path: Path | None, error: BaseException) -> str:
    """Return the location of a failure, as FILE:LINE if it is known.

    The location is that of the syntax error, or of the innermost stack frame in the plug-in.  If there is none, it is
    that of the innermost frame outside of the import system, except for an error of clsplat; otherwise, the path of the
    plug-in's file, or the name of its module.
    """
    if isinstance(error, SyntaxError) and error.filename and Path(error.filename).is_file():
        return f"{error.filename}:{error.lineno}"
    frames = [
        (str(frame.f_globals.get("__name__")), frame.f_code.co_filename, line)
        for frame, line in traceback.walk_tb(error.__traceback__)
    ]
    frames = [frame for frame in frames if "importlib" not in frame[0] and frame[0] not in (__name__, "contextlib")]
    plugin_frames = [
        (file, line)
        for name, file, line in frames
        if _is_within(name, module.partition(".")[0]) or (path and Path(file).is_relative_to(path.parent))
    ]
    if plugin_frames or (frames and not isinstance(error, ClsplatError)):
        file, line = plugin_frames[-1] if plugin_frames else frames[-1][1:]
        return f"{file}:{line}"
    return str(path or getattr(sys.modules.get(module), "__file__", None) or module)


def _failure(location: str, error: BaseException) -> ConfigError:
    """Return an error with the location and the reason in one line."""
    if isinstance(error, ClsplatError):
        return ConfigError(f"{location}: {error}")
    reason = error.msg if isinstance(error, SyntaxError) else " ".join(str(error).split()) or "no message"
    return ConfigError(f"{location}: importing the plug-in failed: {type(error).__name__}: {reason[:300]}")
