"""Locate the package's files and compute its version, with a commit or digest for development versions."""

import hashlib
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from clsplat.core.reading import sha256

__version__ = "0.2.0.dev0"
PACKAGE = Path(__file__).resolve().parents[1]
CODE = ("clsplat", "cl_kernels", "data_tools", "pipelines")  # folders of a checkout


def resource_dir(name: str) -> Path:
    """Return the folder `cl_kernels` or `pipelines`: inside the package in a wheel, next to it in a checkout."""
    for base in (PACKAGE, PACKAGE.parent):
        if (base / name).is_dir():
            return base / name
    raise FileNotFoundError(f"{name}/ is missing in {PACKAGE} and next to it; install clsplat again")


@cache
def full_version() -> str:
    """Return the version; a development version ends with the commit or a digest of the code.

    `0.2.0.dev0+g1a2b3c4` is a checkout at that commit without changes; `0.2.0.dev0+d5e6f7a8b` is anything else.
    """
    if ".dev" not in __version__:
        return __version__
    commit = _commit(PACKAGE.parent)
    return f"{__version__}+g{commit}" if commit else f"{__version__}+d{_digest(_list_code_files())}"


def list_sources() -> list[str]:
    """Return the names and hashes of the Python files and kernels that determine the results."""
    tools = PACKAGE / "data_tools"  # in a wheel; a checkout has it next to the package
    modules = [path for path in PACKAGE.rglob("*.py") if not path.is_relative_to(tools)]
    folder = resource_dir("cl_kernels")
    kernels = [path for pattern in ("*.cl", "*.h") for path in folder.rglob(pattern)]
    return [
        f"{path.relative_to(root).as_posix()} {sha256(path)}"
        for root, paths in ((PACKAGE, modules), (folder, kernels))
        for path in sorted(paths)
    ]


def _list_code_files() -> list[str]:
    """Return the names and hashes of all files of the program, including pipelines, page templates, and data tools."""
    folders = [PACKAGE if name == "clsplat" else resource_dir(name) for name in CODE]
    return [
        f"{folder.name}/{path.relative_to(folder).as_posix()} {sha256(path)}"
        for folder in folders
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".pyc"
    ]


def _commit(root: Path) -> str:
    """Return the commit of a checkout, or "" if its code has uncommitted changes or it is not a checkout."""
    if not (root / ".git").exists() or _git(root, "status", "--porcelain", "--", *CODE) != "":
        return ""
    return _git(root, "rev-parse", "--short=7", "HEAD") or ""


def _git(root: Path, *arguments: str) -> str | None:
    """Return the output of git, or None if it fails or is not installed."""
    try:
        process = subprocess.run(
            ["git", "--no-optional-locks", "-C", str(root), *arguments], capture_output=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return process.stdout.decode("utf-8", "replace").strip()


def _digest(lines: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:8]
