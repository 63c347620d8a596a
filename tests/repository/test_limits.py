"""Limits on the size of files and functions, and the contents of the wheel."""

import ast
import tomllib
from collections import defaultdict

from clsplat.core.resources import resource_dir
from tests.support.sources import FILES, PATHS, ROOT, own_imports

MAX_LINES, MAX_FUNCTION_LINES = 600, 60
SECTION_LINES = 80  # a shorter module that only one sibling imports is a section of it
MAPPED = {
    "clsplat.cl_kernels",
    "clsplat.data_tools",
    "clsplat.pipelines",
}  # folders next to the package that go into it
DATA = {"clsplat.core.templates"}  # folders without modules


def test_modules_and_functions_have_a_useful_size():
    lengths = {path: len(path.read_text().splitlines()) for path in FILES}
    faults = [f"{path.relative_to(ROOT)}: {n} lines; divide it" for path, n in lengths.items() if n > MAX_LINES]
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                if lines > MAX_FUNCTION_LINES:
                    faults.append(f"{path.relative_to(ROOT)}:{node.lineno}: {node.name} has {lines} lines")
    importers = defaultdict(set)
    for module, _, target in own_imports():
        importers[target].add(PATHS[module])
    for module, users in importers.items():
        path = PATHS[module]
        if lengths[path] < SECTION_LINES and path.name != "__init__.py" and len(users) == 1:
            (user,) = users
            if user.parent == path.parent and user.name != "__init__.py":
                faults.append(
                    f"{path.relative_to(ROOT)}: {lengths[path]} lines; only {user.name} imports it: merge them"
                )
    assert not faults, "\n".join(faults)


def test_class_names_are_unique():
    places = defaultdict(list)
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    faults = [f"{name}: {', '.join(found)}; rename all but one" for name, found in places.items() if len(found) > 1]
    assert not faults, "\n".join(faults)


def test_wheel_contains_every_package():
    """What pyproject.toml lists is what lies on disk, and the folders that it maps exist."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    markers = [path.parent for folder in ("clsplat", "data_tools") for path in (ROOT / folder).rglob("__init__.py")]
    on_disk = {".".join(folder.relative_to(ROOT).parts) for folder in markers} - {"data_tools"}
    assert sorted(setuptools["packages"]) == sorted(on_disk | MAPPED | DATA)
    assert setuptools["package-dir"].keys() == MAPPED
    for package, folder in setuptools["package-dir"].items():
        assert list((ROOT / folder).glob(setuptools["package-data"].get(package, ["*.py"])[0])), folder
    without_marker = {path.parent for path in FILES} - set(markers)
    assert not without_marker, "folders of Python files that are not packages"


def test_data_files_are_in_the_wheel():
    """Whatever lies in a package and is not Python is named by package-data."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {package: ROOT / package.replace(".", "/") for package in setuptools["packages"]}
    folders |= {package: ROOT / folder for package, folder in setuptools["package-dir"].items()}
    for package, folder in folders.items():
        named = {path for pattern in setuptools["package-data"].get(package, []) for path in folder.glob(pattern)}
        others = {path for path in folder.iterdir() if path.is_file() and path.suffix not in (".py", ".pyc")}
        assert others <= named, f"{package}: {sorted(path.name for path in others - named)}"
    assert resource_dir("cl_kernels") == ROOT / "cl_kernels", "tests are of this checkout"
