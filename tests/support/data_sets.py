"""The folder of real datasets for tests: $CLSPLAT_DATA, or one next to the checkout."""

import os
from pathlib import Path

import pytest

ROOT = Path(os.environ.get("CLSPLAT_DATA") or Path(__file__).parents[3] / "shared" / "data")


def data_set(name: str) -> Path:
    """Return the folder of a dataset, or skip the test where it is missing."""
    path = ROOT / name
    if not path.is_dir():
        pytest.skip(f"no dataset {path}; set CLSPLAT_DATA to the folder that holds {name}")
    return path
