"""Read what can be read of a dataset: a damaged part becomes a fault, and the reading goes on."""

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from clsplat.errors import DataError
from clsplat.inspect.headers import read_header
from clsplat.scene.colmap import find_models, image_folder, view_of
from clsplat.scene.colmap_files import PointTable, read_cameras, read_images, read_point_table
from clsplat.scene.detect import read_scene
from clsplat.scene.images import inside, is_image
from clsplat.scene.multiscale import FILE, read_multiscale
from clsplat.scene.points import read_ply_table
from clsplat.scene.scene import Scene, View
from clsplat.scene.transforms import Transforms, image_path_of
from clsplat.scene.transforms import view_of as frame_view
from clsplat.stages.init import require_ahead

LOG = logging.getLogger("clsplat")
HOLDOUT = 8  # every so many views are for testing where the dataset does not tell: the default of pipelines
Result = TypeVar("Result")


@dataclass
class Parts:
    """A dataset in pieces.

    `scene` is what training would read, None when it cannot; `refusal` is why training would not start.
    """

    path: Path
    kind: str = "none"
    views: list[View] = field(default_factory=list)  # whether or not their files exist
    models: dict[str, str] = field(default_factory=dict)  # camera models by view, where the dataset names them
    observed: dict[str, int] = field(default_factory=dict)  # points seen, by view, where the dataset tells
    submodels: dict[str, int] = field(default_factory=dict)  # images of each COLMAP model, the one that is used first
    points: PointTable | None = None
    on_disk: list[Path] = field(default_factory=list)  # image files where the views' files are looked for
    expected: list[Path] = field(default_factory=list)  # files that the dataset names
    faults: list[str] = field(default_factory=list)
    scene: Scene | None = None
    refusal: str = ""

    def attempt(self, read: Callable[..., Result], *arguments: Any) -> Result | None:
        """Call a reader; note its DataError and return None."""
        try:
            return read(*arguments)
        except DataError as error:
            if str(error) not in self.faults:
                self.faults.append(str(error))
            return None


def read_parts(path: Path) -> Parts:
    """Read a dataset as read_scene does, but every piece on its own.  Raises DataError when there is no such folder."""
    parts = Parts(path)
    with _silent():
        try:
            parts.scene = read_scene(path, HOLDOUT)
            if parts.scene.points:
                require_ahead(parts.scene.points, parts.scene)
        except DataError as error:
            if not path.is_dir():
                raise
            parts.refusal = str(error)
        if find_models(path):
            _colmap(parts)
        elif (path / "transforms_train.json").is_file():
            _transforms(parts, "Blender", "transforms_train.json", "transforms_test.json")
        elif (path / FILE).is_file():
            parts.kind, scene = "multi-scale Blender", parts.attempt(read_multiscale, path)
            parts.views = list(scene.views) if scene else []
            parts.expected = [view.image_path for view in parts.views]
            parts.points = _ply(parts, path / "points3d.ply") if (path / "points3d.ply").is_file() else None
        elif (path / "transforms.json").is_file():
            _transforms(parts, "nerfstudio", "transforms.json")
    if parts.kind == "COLMAP" or not parts.expected:
        folder = image_folder(path)
        parts.on_disk = list(image_files(folder if folder.is_dir() else path, deep=True))
    else:
        folders = sorted({file.parent for file in parts.expected})
        parts.on_disk = [file for folder in folders for file in image_files(folder, deep=False)]
    if parts.scene:  # some views may be on no split's list
        parts.views = list(parts.scene.views)
    return parts


def image_files(folder: Path, deep: bool) -> Iterator[Path]:
    """Yield the image files in a folder, and with `deep` those in all below it, by name."""
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if not f.startswith(".")) if deep else []
        yield from (Path(place) / name for name in sorted(names) if _is_image(name))


def _is_image(name: str) -> bool:
    return is_image(Path(name)) and not name.startswith(".")


def _colmap(parts: Parts) -> None:
    parts.kind = "COLMAP"
    found = [(folder, parts.attempt(read_images, folder) or []) for folder in find_models(parts.path)]
    found.sort(key=lambda model: -len(model[1]))  # the reader takes the first of the largest, and sorting is stable
    parts.submodels = {str(folder.relative_to(parts.path)): len(images) for folder, images in found}
    model, images = found[0]
    cameras = parts.attempt(read_cameras, model)
    parts.points = parts.attempt(read_point_table, model)
    folder = image_folder(parts.path)
    files = [parts.attempt(inside, folder, image.name, image.where) for image in images]
    parts.expected = [file for file in files if file]
    for image in images if cameras else []:
        if view := parts.attempt(view_of, image, cameras, folder):
            parts.views.append(view)
            parts.models[view.name] = cameras[image.camera].model if cameras else ""
            parts.observed[view.name] = image.observed


def _transforms(parts: Parts, kind: str, *names: str) -> None:
    parts.kind = kind
    files = [parts.attempt(Transforms, parts.path / name) for name in names if (parts.path / name).is_file()]
    for transforms in filter(None, files):
        frames = [(frame, parts.attempt(image_path_of, frame)) for frame in transforms.frames]
        paths = [path for _, path in frames if path]
        parts.expected += paths
        if parts.scene is None:
            first = next((path for path in paths if os.path.isfile(path)), None)
            header = parts.attempt(read_header, first) if first else None
            size = (header.width, header.height) if header else None
            views = [parts.attempt(frame_view, frame, size) for frame, path in frames if path]
            parts.views += [view for view in views if view]
    if files and files[0]:
        place = parts.attempt(files[0].points_path)
        parts.points = _ply(parts, place) if place else None


def _ply(parts: Parts, file: Path) -> PointTable | None:
    table = parts.attempt(read_ply_table, file)
    return PointTable(file, *table, np.empty(0)) if table else None


@contextmanager
def _silent() -> Iterator[None]:
    """Hold back the readers' remarks: the findings tell the same."""
    before = LOG.level
    LOG.setLevel(logging.ERROR)
    try:
        yield
    finally:
        LOG.setLevel(before)
