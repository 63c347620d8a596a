"""The checkout and its Python sources, and what they import: lints read them."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = sorted(path for folder in ("clsplat", "data_tools") for path in (ROOT / folder).rglob("*.py"))
FACES = {"clsplat", "clsplat.__main__", "clsplat.plugin", "clsplat.torch"}  # above all rooms


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    name = ".".join(("clsplat", *parts) if parts[0] == "data_tools" else parts)
    return name.removesuffix(".__init__")


PATHS = {module_of(path): path for path in FILES}


def room(module: str) -> str:
    return module.split(".")[1] if module not in FACES else ""


@functools.cache
def imports(module: str) -> tuple[tuple[ast.stmt, str], ...]:
    """The statements of a module that import, with the full names of the modules that they name."""
    return tuple(_imports(module))


def _imports(module: str) -> Iterator[tuple[ast.stmt, str]]:
    for node in ast.walk(ast.parse(PATHS[module].read_text())):
        if isinstance(node, ast.Import):
            yield from ((node, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 or room(module) == "data_tools", f"{module}:{node.lineno}: relative import"
            base = f"clsplat.data_tools.{node.module or ''}".rstrip(".") if node.level else node.module or ""
            for alias in node.names:
                full = f"{base}.{alias.name}"
                yield node, full if full in PATHS else base


def own_imports() -> Iterator[tuple[str, int, str]]:
    """Yield who imports which module of the package, and in which line; the faces import when a name is first used."""
    for module in PATHS.keys() - {"clsplat"}:
        for node, target in imports(module):
            if target.partition(".")[0] == "clsplat" and target != module:
                yield module, node.lineno, target
