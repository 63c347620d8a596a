"""Make a COLMAP folder from photographs, without a pipeline: the command `clsplat data photos`."""

import shutil
from pathlib import Path

from clsplat.errors import DataError
from clsplat.files import unwritable
from clsplat.prepare.cache import RECORD, plan, prepare
from clsplat.prepare.steps import FindFeatures, MapCameras, MatchFeatures, Step
from clsplat.reading import read_json
from data_tools.gather import link
from data_tools.photos import IMAGES, CameraModel, Mapper, Matching

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

    Raises DataError when `out` holds a model or images of another origin, and the errors of the steps.
    """
    images, sparse = out / IMAGES, out / "sparse"
    if sparse.exists():
        raise DataError(f"{out}: holds a model already, `sparse`; remove it, or give another folder")
    if images.exists() and not images.is_symlink():
        raise DataError(f"{out}: holds `{IMAGES}` already; give another folder")
    steps: list[Step] = [
        FindFeatures(long_side=long_side, camera_model=camera_model),
        MatchFeatures(matching=matching),
        MapCameras(mapper=mapper),
    ]
    result = prepare(plan(steps, source, out / STEPS), source, out / STEPS)
    try:
        images.unlink(missing_ok=True)
        link(result / IMAGES, images)
        half = out / STEPS / ".sparse"
        shutil.rmtree(half, ignore_errors=True)
        shutil.copytree(result / "sparse", half)
        half.rename(sparse)
    except OSError as error:
        raise unwritable(out, error) from error
    return int(read_json(result / RECORD)["registered"])
