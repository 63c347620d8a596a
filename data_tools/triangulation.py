"""Points that two photographs show, beside those that more do: COLMAP leaves pairs out of its models."""

import tempfile
from pathlib import Path
from typing import Any

from data_tools.database import explained
from data_tools.names import IMAGES
from data_tools.pycolmap_import import require_pycolmap

PAIR = 2  # photographs
ERROR = 1.0  # px of the features' size, the mean of both: any two places that match lie near the rays of some point
ANGLE = 1.5  # degrees between two rays; as COLMAP asks of all points


def with_pairs(model: Any, database: Path, out: Path, threads: int = 1) -> Any:
    """Triangulate the points of a model again, of pairs too; its cameras stay.

    database: the features and matches that it was made of; out: the folder with the images.
    """
    pycolmap = require_pycolmap()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = ANGLE
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory(dir=out) as work, explained(out / IMAGES, "triangulate the points"):
        found = pycolmap.triangulate_points(
            model, str(database), str(out / IMAGES), work, clear_points=True, options=options
        )
    for number in [number for number, point in found.points3D.items() if _is_loose(point)]:
        found.delete_point3D(number)
    return found


def _is_loose(point: Any) -> bool:
    return bool(point.track.length() == PAIR and point.error > ERROR)
