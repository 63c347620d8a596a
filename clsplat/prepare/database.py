"""Open pycolmap and its database."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.signals import stopping_on_signals

DATABASE, IMAGES, PAIRS, MODEL = "database.db", "images", "pairs.txt", "sparse"
MATCHING = "matching.json"  # settings of the matching, for further attempts to place photographs
COUNT_PAIRS = """
import sqlite3, sys
with sqlite3.connect(sys.argv[1], uri=True, timeout=0.1) as connection:
    print(connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])
"""


def require_pycolmap() -> ModuleType:
    """Import pycolmap and return it.  Raises ConfigError when it is not installed.

    Importing pycolmap installs a SIGTERM handler that dumps and exits, and reports any exception as a broken install.
    Therefore signals wait until the import has finished, and then get their handlers back.
    """
    signals: list[None] = []
    try:
        with stopping_on_signals(lambda: signals.append(None)):
            import pycolmap
    except ImportError as error:
        raise ConfigError("finding cameras needs pycolmap: pip install 'pycolmap>=4,<5'") from error
    if signals:
        raise KeyboardInterrupt
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)  # errors are raised as exceptions anyway
    return pycolmap


@contextmanager
def open_database(pycolmap: ModuleType, database: Path) -> Iterator[Any]:
    """Open COLMAP's database for the block; create it if necessary."""
    rows = pycolmap.Database.open(str(database))
    try:
        yield rows
    finally:
        rows.close()


def image_names(pycolmap: ModuleType, database: Path) -> list[str]:
    """Return the names of the images, sorted; empty when there is no database."""
    if not database.exists():
        return []
    with open_database(pycolmap, database) as rows:
        return sorted(image.name for image in rows.read_all_images())


def images_without_features(rows: Any) -> dict[int, str]:
    """Return the names of the images without features in an open database, by number, sorted by name."""
    return {
        image.image_id: image.name
        for image in sorted(rows.read_all_images(), key=lambda image: image.name)
        if not (rows.exists_keypoints(image.image_id) and rows.exists_descriptors(image.image_id))
    }


def clear_features(pycolmap: ModuleType, database: Path) -> None:
    """Remove features and matches, but not cameras and images."""
    with open_database(pycolmap, database) as rows:
        for clear in ("two_view_geometries", "matches", "descriptors", "keypoints"):
            getattr(rows, f"clear_{clear}")()


def feature_counts(pycolmap: ModuleType, database: Path) -> dict[str, int]:
    """Return the number of features of each image."""
    with open_database(pycolmap, database) as rows:
        return {image.name: rows.num_keypoints_for_image(image.image_id) for image in rows.read_all_images()}


def verified_pairs(pycolmap: ModuleType, database: Path) -> dict[tuple[str, str], int]:
    """Return the number of geometrically verified matches of each pair that has any."""
    with open_database(pycolmap, database) as rows:
        names = {image.image_id: image.name for image in rows.read_all_images()}
        pairs, counts = rows.read_two_view_geometry_num_inliers()
    numbers = map(pycolmap.pair_id_to_image_pair, pairs)
    return {(names[a], names[b]): count for (a, b), count in zip(numbers, counts, strict=True) if count}


@contextmanager
def raising_data_error(path: Path, action: str) -> Iterator[None]:
    """Convert an error of pycolmap in the block to a DataError with a message of one sentence."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise DataError(f"{path}: could not {action} ({str(error).splitlines()[0]}); check the photographs") from error


def count_matched_pairs(database: Path) -> int:
    """Return the number of pairs that pycolmap has matched so far; 0 when it cannot be read at the moment.

    A child process reads it: a second SQLite library in pycolmap's process would release the locks of the first
    (https://www.sqlite.org/howtocorrupt.html, 2.2.1), and matches would be lost.
    """
    address = f"{database.resolve().as_uri()}?mode=ro"
    try:
        command = [sys.executable, "-I", "-S", "-c", COUNT_PAIRS, address]
        return int(subprocess.check_output(command, stderr=subprocess.DEVNULL))
    except (OSError, subprocess.CalledProcessError):
        return 0


def remove_database(database: Path) -> None:
    """Remove a database and its journal."""
    for file in database.parent.glob(f"{database.name}*"):
        file.unlink()
