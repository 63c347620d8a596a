"""Make a COLMAP folder from photographs, without a pipeline: the command `clsplat data photos`."""

import shutil
from pathlib import Path

from clsplat import lock
from clsplat.errors import DataError
from clsplat.files import make_folder, sync_below, sync_folder, told_as
from clsplat.names import LOCK
from clsplat.prepare.cache import RECORD, plan, prepare
from clsplat.prepare.database import IMAGES, MODEL
from clsplat.prepare.features import CameraModel
from clsplat.prepare.gather import link
from clsplat.prepare.mapping import Mapper
from clsplat.prepare.matching import Matching
from clsplat.prepare.steps import FindFeatures, MapCameras, MatchFeatures, Step
from clsplat.reading import read_json

STEPS = ".steps"  # in the folder of the scene: results from which an interrupted call continues


def place_photographs(
    source: Path,
    out: Path,
    long_side: int = 1600,
    camera_model: CameraModel = "SIMPLE_RADIAL",
    matching: Matching = "auto",
    mapper: Mapper = "incremental",
) -> int:
    """Find the cameras of the photographs in `source`, write a COLMAP folder `out`; return the number of its images.

    Raises DataError when `out` holds a model or images of another origin, OutputError when another process uses it,
    and the errors of the steps.
    """
    _require_free(out)
    steps: list[Step] = [
        FindFeatures(long_side=long_side, camera_model=camera_model),
        MatchFeatures(matching=matching),
        MapCameras(mapper=mapper),
    ]
    with told_as(out):
        make_folder(out / STEPS)
    with lock.held(out, out / STEPS / LOCK):
        _require_free(out)  # again: another call may have ended since
        result = prepare(plan(steps, source, out / STEPS), source, out / STEPS)
        _show(result, out)
    return int(read_json(result / RECORD)["registered"])


def _require_free(out: Path) -> None:
    """Raise DataError where the folder holds what would be written there."""
    images = out / IMAGES
    if (out / MODEL).exists():
        raise DataError(f"{out}: holds a model already, `{MODEL}`; remove it, or give another folder")
    if images.exists() and not images.is_symlink():
        raise DataError(f"{out}: holds `{IMAGES}` already; give another folder")


def _show(result: Path, out: Path) -> None:
    """Let `out` be a COLMAP folder: link the images of the last step, copy its model.  Raises OutputError."""
    with told_as(out):
        (out / IMAGES).unlink(missing_ok=True)
        link(result / IMAGES, out / IMAGES)
        half = out / STEPS / f".{MODEL}"
        shutil.rmtree(half, ignore_errors=True)
        shutil.copytree(result / MODEL, half)
        sync_below(half)
        half.rename(out / MODEL)
        sync_folder(out)
