"""The pinhole camera that everything is rendered with."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: image size, focal lengths and principal point, in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def resized(self, width: int, height: int) -> "Camera":
        """Return the camera of the same photograph resampled to another size."""
        sx, sy = width / self.width, height / self.height
        return Camera(width, height, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy)

    def downscaled(self, factor: float) -> "Camera":
        """Return the camera after dividing the image size by `factor`, rounded to whole pixels."""
        if factor == 1:
            return self
        return self.resized(max(1, round(self.width / factor)), max(1, round(self.height / factor)))
