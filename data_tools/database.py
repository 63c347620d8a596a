"""What COLMAP's database holds so far."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

COUNT_ROWS = """
import sqlite3, sys
with sqlite3.connect(sys.argv[1], uri=True, timeout=0.1) as opened:
    print(opened.execute(f"SELECT COUNT(*) FROM {sys.argv[2]}").fetchone()[0])
"""


def image_names(pycolmap: ModuleType, database: Path) -> list[str]:
    """Return the names of the images, sorted."""
    opened = pycolmap.Database.open(str(database))
    try:
        return sorted(image.name for image in opened.read_all_images())
    finally:
        opened.close()


def without_features(pycolmap: ModuleType, database: Path) -> list[str]:
    """Return the names of images whose features are not in the database, or not all, sorted."""
    opened = pycolmap.Database.open(str(database))
    try:
        return sorted(
            image.name
            for image in opened.read_all_images()
            if not (opened.exists_keypoints(image.image_id) and opened.exists_descriptors(image.image_id))
        )
    finally:
        opened.close()


def matched_pairs(pycolmap: ModuleType, database: Path) -> int:
    """Return the number of pairs whose matches pass geometric verification."""
    opened = pycolmap.Database.open(str(database))
    try:
        _, inliers = opened.read_two_view_geometry_num_inliers()
        return int(np.count_nonzero(inliers))
    finally:
        opened.close()


def pairs_done(database: Path) -> int:
    """Return the number of pairs that were looked at, while pycolmap writes; 0 where that cannot be read just now."""
    return _rows(database, "two_view_geometries")


def features_done(database: Path) -> int:
    """Return the number of images with features, while pycolmap writes; 0 where that cannot be read just now."""
    return _rows(database, "descriptors")


def _rows(database: Path, table: str) -> int:
    """The number of rows of a table.

    A process of its own reads it: a second SQLite library in pycolmap's process would release the locks of the first
    (https://www.sqlite.org/howtocorrupt.html, 2.2.1), and matches would be lost.
    """
    address = f"{database.resolve().as_uri()}?mode=ro"
    try:
        command = [sys.executable, "-I", "-S", "-c", COUNT_ROWS, address, table]
        return int(subprocess.check_output(command, stderr=subprocess.DEVNULL))
    except (OSError, subprocess.CalledProcessError):
        return 0


def remove(database: Path) -> None:
    """Remove a database with its journal."""
    for file in database.parent.glob(f"{database.name}*"):
        file.unlink()
