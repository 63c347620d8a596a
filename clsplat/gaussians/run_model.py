"""Where a run folder, or another path, has its model."""

from pathlib import Path

from clsplat.errors import DataError
from clsplat.formats.model_files import located
from clsplat.names import METRICS, is_inside
from clsplat.reading import read_json

MODEL = "point_cloud.ply"  # of a run that does not name its own


def model_at(path: Path) -> Path:
    """Return the model file that a path names: of a folder of SOG its meta.json, of a run folder its model."""
    place = located(path)
    return model_of_run(place) if place.is_dir() else place


def model_of_run(folder: Path) -> Path:
    """Return the model file of a run folder: the last export, as its metrics.json names it."""
    return file_of_run(folder, "export", MODEL)


def file_of_run(folder: Path, stage: str, default: str) -> Path:
    """Return the file of the last stage of a name, as metrics.json of a run folder has it, else the default one."""
    try:
        name = read_json(folder / METRICS)["files"][stage]
    except (DataError, KeyError, TypeError):  # not finished
        name = default
    return folder / (name if isinstance(name, str) and is_inside(name) else default)


def as_trained(file: Path) -> Path:
    """Return the PLY beside a model of a run that holds its world filter apart, where there is one, else the model."""
    raw = file.with_name(f"{file.stem}_raw.ply")
    return raw if raw.is_file() else file
