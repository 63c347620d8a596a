"""What is known of photographs before they are prepared."""

import logging
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from clsplat.core.errors import DataError
from clsplat.core.progress import only
from clsplat.pipeline.loading import Pipeline, prepared_folder
from clsplat.prepare.cache import Planned
from clsplat.prepare.gather import list_photographs
from clsplat.scene.camera import Camera
from clsplat.scene.quality import Measures
from clsplat.scene.scene import Scene, every_nth, make_scene
from clsplat.scene.view import View
from clsplat.scene.view_selection import OfPlaced


def listed(pipeline: Pipeline, planned: Sequence[Planned], out: Path) -> list[str]:
    """Return the names of what is to be prepared; none where `prepare` finds no photographs by itself.

    The log says which files are left out.
    """
    try:
        return (
            list_photographs(pipeline.settings.scene.folder, prepared_folder(out).parent.resolve()) if planned else []
        )
    except DataError:
        return []


def check_preparation(pipeline: Pipeline, out: Path) -> list[Planned]:
    """Return the steps that prepare the photographs of a run in `out`; nothing is written.

    Raises what is known before the first of them: ConfigError or DataError.
    """
    planned = pipeline.preparation(out)
    if planned and planned[0].why:
        planned[0].step.check(pipeline.settings.scene.folder.resolve(), prepared_folder(out).parent)
    if any(one.why for one in planned):
        _check_split(pipeline, planned, out)
    return planned


def _check_split(pipeline: Pipeline, planned: Sequence[Planned], out: Path) -> None:
    """Raise DataError where the photographs that are to be prepared do not have the split, however many are placed."""
    with only(logging.ERROR):
        names = listed(pipeline, planned, out)
    if not names:
        return
    pipeline.settings.scene.split.check(pipeline.settings.scene.folder, names)
    with suppress(OfPlaced):  # a dry run says it
        _applied(pipeline, names)


def known(pipeline: Pipeline, names: Sequence[str]) -> Measures | None:
    """Return the measures that named photographs have if all are placed: how many train, for validation too.

    None without names.  Raises DataError where the split does not fit all of them.
    """
    return Measures(len(_applied(pipeline, names).with_fold().train)) if names else None


def _applied(pipeline: Pipeline, names: Sequence[str]) -> Scene:
    """The scene of named photographs, all placed, with the split.  Raises DataError."""
    folder, split = pipeline.settings.scene.folder, pipeline.settings.scene.split
    pose = np.eye(3, 4, dtype=np.float32)
    views = [View(name, Camera(1, 1, 1.0, 1.0, 0.5, 0.5), pose, folder / name) for name in names]
    with only(logging.ERROR):
        return split.applied(make_scene(folder, views, every_nth(names, split.of_reader), None, "black"))
