"""The checkout and its Python sources, which lints read."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = sorted(path for folder in ("clsplat", "data_tools") for path in (ROOT / folder).rglob("*.py"))
