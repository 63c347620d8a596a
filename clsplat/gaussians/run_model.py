"""Where a run folder has its model."""

from pathlib import Path

from clsplat.errors import DataError
from clsplat.names import METRICS, is_inside
from clsplat.reading import read_json

MODEL = "point_cloud.ply"  # of a run that does not name its own


def model_of_run(folder: Path) -> Path:
    """Return the model file of a run folder: the last export, as its metrics.json names it."""
    try:
        name = read_json(folder / METRICS)["files"]["export"]
    except (DataError, KeyError, TypeError):  # not finished, or of an earlier version
        name = MODEL
    return folder / (name if isinstance(name, str) and is_inside(name) else MODEL)
