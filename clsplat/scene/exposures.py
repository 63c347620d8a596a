"""What cameras noted of the exposures of views."""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path, PurePosixPath

from clsplat.scene.exif import CameraExposure, exposure_of, read_exposures
from clsplat.scene.view import NO_FILE, View


def camera_exposures(views: Sequence[View]) -> list[CameraExposure | None]:
    """Return the exposure of each view: what lies beside its image, or else what its image tells; None: nothing.

    Raises DataError where a file cannot be read.
    """
    beside = cache(read_exposures)
    found: list[CameraExposure | None] = []
    for view in views:
        if view.image_path == NO_FILE:
            found.append(None)
            continue
        told = (beside(folder).get(name) for folder, name in _below(view))
        found.append(next(filter(None, told), None) or exposure_of(view.image_path))
    return found


def _below(view: View) -> Iterator[tuple[Path, str]]:
    """The folders of its image, up to that below which the name of the view is a path, and its path below each."""
    parts = PurePosixPath(view.name).parts
    for number, folder in enumerate(view.image_path.parents[: len(parts)], 1):
        if view.image_path.parts[-number:] == parts[-number:]:
            yield folder, "/".join(parts[-number:])
