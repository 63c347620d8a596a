"""The plan of a scene in blocks before anything is trained: by the dataset's points, each a Gaussian."""

import logging
import tempfile
from pathlib import Path
from typing import Any

from clsplat.blocks.blocks import Blocks, Plan
from clsplat.errors import DataError, amount
from clsplat.gaussians.model import NUMBERS, Model
from clsplat.opencl.device import Device
from clsplat.pipeline.loading import load
from clsplat.progress import only
from clsplat.runs.scenes import read_run_scene
from clsplat.runs.source import as_setting, photographs_of
from clsplat.stages.init import Init, from_points


def plan_blocks(
    scene: Path, blocks: int, pipeline: str = "blocks", device: str | Device | None = None
) -> dict[str, Any]:
    """Return the manifest of a partition by the scene's points, with the time of each block; nothing is kept.

    Raises ConfigError for a number of blocks out of bounds, DataError where the scene has no points, or too few.
    """
    settings = load(pipeline, [f"scene.path={as_setting(photographs_of(scene))}", "init.file=points"]).settings
    with only(logging.ERROR):  # it is read again, and told then
        points = read_run_scene(settings.scene, settings.scene.folder).original.points
    if points is None or not len(points):
        raise DataError(f"{scene}: has no points to cut by; `clsplat blocks --plan` trains a coarse model first")
    with tempfile.TemporaryDirectory() as made:
        model = Path(made, "points.ply")
        tables = from_points(points, Init().opacity, settings.model.sh_degree)
        Model(**tables, rendering=NUMBERS, sky=None).save(model)
        work = Blocks(scene, Path(made), Plan(pipeline, str(model), blocks), device)
        try:
            return work.plan_of(work.partition())
        except DataError as error:
            raise DataError(f"{scene}, by its {amount(len(points), 'point')}: {error}") from error
