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
MATCHING = "matching.json"  # settings of match_features, which further attempts to register photographs reuse
COUNT_PAIRS = """
import sqlite3, sys
with sqlite3.connect(sys.argv[1], uri=True, timeout=0.1) as connection:
    print(connection.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])
"""


def require_pycolmap() -> ModuleType:
    """Import and return pycolmap.  Raises ConfigError when it is not installed.

    The import installs a SIGTERM handler that prints a stack trace and exits, and reports any exception as a broken
    install.  Signals are therefore deferred until the import has finished, and their handlers are restored.
    """
    signals: list[None] = []
    try:
        with stopping_on_signals(lambda: signals.append(None)):
            import pycolmap
    except ImportError as error:
        raise ConfigError("finding cameras needs pycolmap; run `pip install 'pycolmap>=4,<5'`") from error
    if signals:
        raise KeyboardInterrupt
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)  # errors are raised as exceptions anyway
    return pycolmap


@contextmanager
def open_database(pycolmap: ModuleType, database: Path) -> Iterator[Any]:
    """Open a COLMAP database during the block, and create it if it does not exist."""
    db = pycolmap.Database.open(str(database))
    try:
        yield db
    finally:
        db.close()


def read_image_names(pycolmap: ModuleType, database: Path) -> list[str]:
    """Return the sorted names of the images in a database.  Empty if the file does not exist."""
    if not database.exists():
        return []
    with open_database(pycolmap, database) as db:
        return sorted(image.name for image in db.read_all_images())


def read_min_long_side(pycolmap: ModuleType, database: Path) -> int:
    """Return the smallest long side of the cameras in a database, px."""
    with open_database(pycolmap, database) as db:
        return int(min(max(camera.width, camera.height) for camera in db.read_all_cameras()))


def find_images_without_features(db: Any) -> dict[int, str]:
    """Return the names of the images without features in an open database, by image ID, sorted by name."""
    return {
        image.image_id: image.name
        for image in sorted(db.read_all_images(), key=lambda image: image.name)
        if not (db.exists_keypoints(image.image_id) and db.exists_descriptors(image.image_id))
    }


def clear_features(pycolmap: ModuleType, database: Path) -> None:
    """Remove the features and matches from a database, and keep its cameras and images."""
    with open_database(pycolmap, database) as db:
        for table in ("two_view_geometries", "matches", "descriptors", "keypoints"):
            getattr(db, f"clear_{table}")()


def read_feature_counts(pycolmap: ModuleType, database: Path) -> dict[str, int]:
    """Return the number of features of each image in a database, by the name of the image."""
    with open_database(pycolmap, database) as db:
        return {image.name: db.num_keypoints_for_image(image.image_id) for image in db.read_all_images()}


def read_verified_pairs(pycolmap: ModuleType, database: Path) -> dict[tuple[str, str], int]:
    """Return the number of verified matches of each pair of images in a database, without pairs that have none."""
    with open_database(pycolmap, database) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        pairs, counts = db.read_two_view_geometry_num_inliers()
    id_pairs = map(pycolmap.pair_id_to_image_pair, pairs)
    return {(names[a], names[b]): count for (a, b), count in zip(id_pairs, counts, strict=True) if count}


@contextmanager
def raising_data_error(path: Path, action: str) -> Iterator[None]:
    """Convert errors of pycolmap in the block to a DataError that names the path and the action that failed."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise DataError(f"{path}: could not {action} ({str(error).splitlines()[0]}); check the photos") from error


def count_matched_pairs(database: Path) -> int:
    """Return the number of pairs that pycolmap has matched so far, or 0 if the database cannot be read at the moment.

    A child process reads it: a second SQLite library in pycolmap's process would release the locks of the first
    (https://www.sqlite.org/howtocorrupt.html, 2.2.1), and matches would be lost.
    """
    uri = f"{database.resolve().as_uri()}?mode=ro"
    try:
        command = [sys.executable, "-I", "-S", "-c", COUNT_PAIRS, uri]
        return int(subprocess.check_output(command, stderr=subprocess.DEVNULL))
    except (OSError, subprocess.CalledProcessError):
        return 0


def remove_database(database: Path) -> None:
    """Remove a database and its journal files."""
    for file in database.parent.glob(f"{database.name}*"):
        file.unlink()
