"""The pinhole camera of all rendering."""

import math
from dataclasses import astuple, dataclass, replace
from numbers import Integral

MAX_SIDE = 4096 * 8  # px: the tiles that cl_kernels/tiles.h can name, of the smallest size that a device has
MIN_FOCAL = 1e-3  # px, in a dataset: with less an image shows half of all directions


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: image size, focal lengths and principal point, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def check(self) -> "Camera":
        """Return the camera.

        Raises ValueError unless sizes are whole and at most MAX_SIDE, sizes and focal lengths positive, and all numbers
        finite.
        """
        if not (isinstance(self.width, Integral) and isinstance(self.height, Integral)):
            raise ValueError(f"the camera is {self.width}x{self.height}; expected whole numbers of pixels, of type int")
        if max(self.width, self.height) > MAX_SIDE:
            raise ValueError(f"the camera is {self.width}x{self.height} pixels; expected at most {MAX_SIDE} to a side")
        if min(self.width, self.height, self.fx, self.fy) <= 0 or not all(map(math.isfinite, astuple(self))):
            raise ValueError(
                f"the camera is {self.width}x{self.height} with focal lengths {self.fx}, {self.fy} and principal point "
                f"{self.cx}, {self.cy}; expected a positive size, positive focal lengths and finite numbers"
            )
        return self

    def zoomed(self, factor: float) -> "Camera":
        """Return the camera with both focal lengths times a factor."""
        return self if factor == 1 else replace(self, fx=factor * self.fx, fy=factor * self.fy)

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same photograph resampled to another size."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def downscaled(self, factor: float) -> "Camera":
        """Return the camera after dividing the image size by `factor`, rounded to whole pixels."""
        if factor == 1:
            return self
        return self.resized(max(1, round(self.width / factor)), max(1, round(self.height / factor)))
