"""Read a dataset in pieces: a damaged piece becomes a fault, and the other pieces are read."""

import logging
import os
from collections.abc import Iterator
from pathlib import Path

from clsplat.errors import DataError
from clsplat.prepare.gather import list_photographs
from clsplat.progress import kept, only
from clsplat.scene.detect import read_scene, reader_of
from clsplat.scene.images import is_image
from clsplat.scene.parts import Parts
from clsplat.scene.reprojection import require_ahead

LOG = logging.getLogger("clsplat")


def read_parts(path: Path) -> Parts:
    """Read a dataset as read_scene does, but every piece on its own.  Raises DataError when there is no such folder."""
    parts = Parts(path)
    with only(logging.ERROR):
        try:
            parts.scene = read_scene(path)
            if parts.scene.points:
                require_ahead(parts.scene.points, parts.scene)
        except DataError as error:
            if not path.is_dir():
                raise
            parts.refusal = str(error)
        if reader := reader_of(path):
            parts.kind = reader.name
            reader.list_parts(parts)
    if parts.kind == "none":
        _list_photographs(parts)
    elif parts.image_folder or not parts.expected:
        folder = parts.image_folder or path / "images"
        parts.on_disk = list(image_files(folder if folder.is_dir() else path, deep=True))
    else:
        folders = sorted({file.parent for file in parts.expected})
        parts.on_disk = [file for folder in folders for file in image_files(folder, deep=False)]
    if parts.scene:  # some views may be on no split's list
        parts.views = list(parts.scene.views)
    return parts


def _list_photographs(parts: Parts) -> None:
    """List the photographs of a folder without cameras, and what their preparation would say of them."""
    parts.on_disk = list(image_files(parts.path, deep=True))
    with kept(logging.WARNING) as parts.left_out:
        try:
            list_photographs(parts.path)
        except DataError as error:
            if parts.on_disk or parts.left_out:
                parts.refusal = str(error)


def image_files(folder: Path, deep: bool) -> Iterator[Path]:
    """Yield the image files in a folder, and with `deep` those in all below it, by name."""
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(f for f in folders if not f.startswith(".")) if deep else []
        yield from (Path(place) / n for n in sorted(names) if is_image(Path(n)) and not n.startswith("."))
