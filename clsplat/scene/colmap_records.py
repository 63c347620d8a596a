"""Records of a COLMAP model, binary or text: camera models, cameras and images."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError, quoted

# Camera models in order of their ids, with the number of parameters (COLMAP 4, sensor/models.h).
PARAMETERS = {
    **{"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8},
    **{"FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12},
    **{"RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4},
    **{"EUCM": 6, "EQUIRECTANGULAR": 2},
}
MODELS = list(PARAMETERS)
REMEDY = "copy or export the model again"


class CameraRecord(NamedTuple):
    """A line of `cameras`; `where` is its place, for messages."""

    where: str
    model: str
    width: int
    height: int
    params: tuple[float, ...]


class ImageRecord(NamedTuple):
    """A line of `images`: quaternion (w, x, y, z) and translation, world to camera.

    `points` are the ids of the 3D points that its 2D points show, `places` where, [K, 2] px.
    """

    where: str
    name: str
    camera: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    points: NDArray[np.int64] = np.empty(0, np.int64)
    places: NDArray[np.float64] = np.empty((0, 2))

    @property
    def observed(self) -> int:
        """The number of its 2D points that show a 3D point."""
        return len(self.points)


def parameter_count(where: str, model: str) -> int:
    """Return the number of parameters of a camera model.  Raises DataError, starting with `where`, for others."""
    if model not in PARAMETERS:
        raise DataError(f"{where}: unknown camera model {quoted(model)}; expected one of {', '.join(PARAMETERS)}")
    return PARAMETERS[model]


def decode(where: str, data: bytes) -> str:
    """Return bytes as text.  Raises DataError, starting with `where`, when they are not UTF-8."""
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise DataError(f"{where}: not UTF-8 text ({error}); {REMEDY}") from error
