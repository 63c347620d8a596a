"""What cameras noted of the exposures of views."""

from collections.abc import Sequence
from functools import cache

from clsplat.scene.exif import CameraExposure, exposure_of, read_exposures
from clsplat.scene.view import NO_FILE, View


def camera_exposures(views: Sequence[View]) -> list[CameraExposure | None]:
    """Return the exposure of each view: what lies beside its image, or else what its image tells; None: nothing.

    Raises DataError where a file cannot be read.
    """
    beside = cache(read_exposures)
    found: list[CameraExposure | None] = []
    for view in views:
        folders = [] if view.image_path == NO_FILE else list(view.image_path.parents)
        names = {folder: view.image_path.relative_to(folder).as_posix() for folder in folders}
        folder = next((one for one in folders if names[one] == view.name), None)  # names are paths below it
        exposure = beside(folder).get(view.name) if folder else None
        found.append(exposure or (exposure_of(view.image_path) if folders else None))
    return found
