"""Child processes import nothing from the working folder, which may be untrusted."""

import ast
import os
import subprocess
import sys

from tests.support.sources import ROOT

ISOLATED = ("-P", "-I")
STARTS = "import sys; sys.path.pop(0); from clsplat.__main__ import main; main()"  # as the installed command does


def executables(tree: ast.AST) -> list[ast.expr]:
    """Return the words that stand for this Python in a module."""
    return [
        node
        for node in ast.walk(tree)
        if (isinstance(node, ast.Attribute) and ast.unparse(node) == "sys.executable")
        or (isinstance(node, ast.Name) and node.id == "PYTHON" and isinstance(node.ctx, ast.Load))
    ]


def isolated(tree: ast.Module) -> list[ast.expr]:
    """Return those that begin a command with -P or -I; a constant of the module may hold the words."""
    constants = {ast.unparse(node.targets[0]): node.value for node in tree.body if isinstance(node, ast.Assign)}
    results = []
    for command in (node for node in ast.walk(tree) if isinstance(node, ast.List) and len(node.elts) > 1):
        first, second = command.elts[:2]
        if isinstance(second, ast.Starred):
            words = constants.get(ast.unparse(second.value))
            second = words.elts[0] if isinstance(words, ast.Tuple) else second
        if isinstance(second, ast.Constant) and second.value in ISOLATED:
            results.append(first)
    return results


def test_every_child_command_is_isolated():
    count, others = 0, {}
    for path in [*(ROOT / "clsplat").rglob("*.py"), *(ROOT / "data_tools").rglob("*.py")]:
        tree = ast.parse(path.read_text("utf-8"))
        used, safe = executables(tree), isolated(tree)
        count += sum(node in safe for node in used)
        if left := [ast.unparse(node) for node in used if node not in safe]:
            others[path.relative_to(ROOT).as_posix()] = left
    assert count >= 4
    assert others == {"clsplat/sweeps/child.py": ["PYTHON", "sys.executable"]}, "begin it with sys.executable, -P"


def test_workers_import_nothing_from_the_working_folder(tmp_path):
    """Those of multiprocessing, which Dask uses as well, start with `-c`."""
    (tmp_path / "multiprocessing.py").write_text("open('ran', 'w')")
    words = ["data", "synthetic", "out", "--train", "2", "--test", "1", "--size", "16"]
    places = [str(ROOT), *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(places)}
    environment.pop("PYTHONSAFEPATH", None)
    command = [sys.executable, "-c", STARTS, *words]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists()
