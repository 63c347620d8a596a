"""Limits that keep the house readable: sizes of files and functions, and every package in the wheel."""

import ast
import tomllib

import pytest

from clsplat.core.resources import resource_dir
from tests.support.sources import FILES, ROOT

MAX_LINES = 250
MAX_FUNCTION_LINES = 60
MAPPED = {"clsplat.cl_kernels", "clsplat.data_tools", "clsplat.pipelines"}  # folders beside the package that go into it
DATA = {"clsplat.pages.templates"}  # folders without modules
files = pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))


@files
def test_files_are_short(path):
    lines = len(path.read_text().splitlines())
    assert lines <= MAX_LINES, f"{path.relative_to(ROOT)} has {lines} lines; divide it"


@files
def test_functions_fit_a_screen(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            lines = node.end_lineno - node.lineno + 1
            assert lines <= MAX_FUNCTION_LINES, f"{path.relative_to(ROOT)}:{node.lineno}: {node.name} has {lines} lines"


def test_the_wheel_holds_every_package():
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


def test_files_beside_the_code_are_in_the_wheel():
    """Whatever lies in a package and is not Python is named by package-data."""
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {package: ROOT / package.replace(".", "/") for package in setuptools["packages"]}
    folders |= {package: ROOT / folder for package, folder in setuptools["package-dir"].items()}
    for package, folder in folders.items():
        named = {path for pattern in setuptools["package-data"].get(package, []) for path in folder.glob(pattern)}
        others = {path for path in folder.iterdir() if path.is_file() and path.suffix not in (".py", ".pyc")}
        assert others <= named, f"{package}: {sorted(path.name for path in others - named)}"
    assert resource_dir("cl_kernels") == ROOT / "cl_kernels", "tests are of this checkout"
