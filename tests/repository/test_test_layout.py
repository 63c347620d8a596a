"""Tests mirror the packages, share helpers only through tests/support, and have short names."""

import ast
from collections.abc import Iterator

from tests.support.sources import PATHS, ROOT, room

MODULES = {path: ast.parse(path.read_text()) for path in sorted((ROOT / "tests").rglob("test_*.py"))}
MAX_LETTERS = 60
OTHERS = {"repository", "support", "torture", "fuzz", "typing", "targets"}  # folders that are no room's


def test_each_room_has_a_folder_of_tests():
    rooms = {room(module) for module in PATHS} - {""}
    folders = {path.relative_to(ROOT / "tests").parts[0] for path in MODULES if path.parent != ROOT / "tests"}
    assert rooms - folders == set(), "a room without tests"
    assert folders - rooms - OTHERS == set(), "a folder that is no room"
    assert not [path for path in MODULES if path.parent == ROOT / "tests"], "a module outside of a room"


def imported(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    if isinstance(node, ast.ImportFrom):
        yield from (node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names))


def test_no_test_module_imports_another():
    faults = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {name}"
        for path, tree in MODULES.items()
        for node in ast.walk(tree)
        for name in imported(node)
        if name.startswith("tests.") and name.rpartition(".")[2].startswith("test_")
    ]
    assert not faults, "move what they share to tests/support:\n" + "\n".join(faults)


def test_test_names_are_short():
    faults = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        for path, tree in MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and len(node.name) > MAX_LETTERS
    ]
    assert not faults, f"more than {MAX_LETTERS} letters:\n" + "\n".join(faults)
