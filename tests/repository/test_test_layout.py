"""Tests use each other's helpers through tests/support alone, and their names stay short."""

import ast

from tests.support.sources import ROOT

MODULES = {path: ast.parse(path.read_text()) for path in sorted((ROOT / "tests").rglob("test_*.py"))}
MAX_LETTERS = 60


def test_no_test_module_imports_another():
    faults = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.module}"
        for path, tree in MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests.")
        if (node.module or "").rpartition(".")[2].startswith("test_")
    ]
    assert not faults, "move what they share to tests/support:\n" + "\n".join(faults)


def test_names_of_tests_are_short():
    faults = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        for path, tree in MODULES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_") and len(node.name) > MAX_LETTERS
    ]
    assert not faults, f"more than {MAX_LETTERS} letters:\n" + "\n".join(faults)
