"""pycolmap and its database: what is in it so far."""

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
MATCHING = "matching.json"  # how photographs were matched, for further attempts
COUNT_ROWS = """
import sqlite3, sys
with sqlite3.connect(sys.argv[1], uri=True, timeout=0.1) as opened:
    print(opened.execute(f"SELECT COUNT(*) FROM {sys.argv[2]}").fetchone()[0])
"""


def require_pycolmap() -> ModuleType:
    """Return pycolmap.  Raises ConfigError where it is not installed.

    Its import takes SIGTERM, to end the process with a dump, and for any exception says that pycolmap is broken: so
    signals wait for its end, where they get their handlers back.
    """
    signals: list[None] = []
    try:
        with stopping_on_signals(lambda: signals.append(None)):
            import pycolmap
    except ImportError as error:
        raise ConfigError("placing photographs needs pycolmap: pip install 'pycolmap>=4,<5'") from error
    if signals:
        raise KeyboardInterrupt
    pycolmap.logging.minloglevel = int(pycolmap.logging.FATAL.value)  # what ends a step is raised too
    return pycolmap


@contextmanager
def opened(pycolmap: ModuleType, database: Path) -> Iterator[Any]:
    """COLMAP's database for the block; a new one where there is none."""
    rows = pycolmap.Database.open(str(database))
    try:
        yield rows
    finally:
        rows.close()


def image_names(pycolmap: ModuleType, database: Path) -> list[str]:
    """Return the names of the images, sorted; none where there is no database."""
    if not database.exists():
        return []
    with opened(pycolmap, database) as rows:
        return sorted(image.name for image in rows.read_all_images())


def without_features(rows: Any) -> dict[int, str]:
    """Return the images of an opened database whose features are not in it, by number, in order of their names."""
    return {
        image.image_id: image.name
        for image in sorted(rows.read_all_images(), key=lambda image: image.name)
        if not (rows.exists_keypoints(image.image_id) and rows.exists_descriptors(image.image_id))
    }


def clear_features(pycolmap: ModuleType, database: Path) -> None:
    """Remove features and matches; cameras and images stay."""
    with opened(pycolmap, database) as rows:
        for clear in ("two_view_geometries", "matches", "descriptors", "keypoints"):
            getattr(rows, f"clear_{clear}")()


def feature_counts(pycolmap: ModuleType, database: Path) -> dict[str, int]:
    """Return the number of features of each image."""
    with opened(pycolmap, database) as rows:
        return {image.name: rows.num_keypoints_for_image(image.image_id) for image in rows.read_all_images()}


def verified(pycolmap: ModuleType, database: Path) -> dict[tuple[str, str], int]:
    """Return the pairs whose matches pass geometric verification, with the number of these."""
    with opened(pycolmap, database) as rows:
        names = {image.image_id: image.name for image in rows.read_all_images()}
        pairs, counts = rows.read_two_view_geometry_num_inliers()
    found = zip(map(pycolmap.pair_id_to_image_pair, pairs), counts, strict=True)
    return {(names[a], names[b]): count for (a, b), count in found if count}


@contextmanager
def explained(place: Path, what: str) -> Iterator[None]:
    """pycolmap's errors as one sentence."""
    try:
        yield
    except (ValueError, RuntimeError) as error:
        raise DataError(f"{place}: could not {what} ({str(error).splitlines()[0]}); check the photographs") from error


def pairs_done(database: Path) -> int:
    """Return the number of pairs that were looked at, while pycolmap writes; 0 where that cannot be read just now."""
    return _rows(database, "two_view_geometries")


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
