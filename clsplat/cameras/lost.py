"""What a file of cameras cannot hold, and takes from them: said in a line."""

import logging
from collections.abc import Sequence
from pathlib import Path

from clsplat.scene.camera import Camera

LOG = logging.getLogger("clsplat")
TOLERANCE = 0.5  # px: less is no more than a convention about the middle of a pixel


def centre_lost(path: Path, cameras: Sequence[Camera], readers: str) -> None:
    """Warn where readers of a file look for the principal point elsewhere than it is."""
    off = max(max(abs(c.cx - c.width / 2), abs(c.cy - c.height / 2)) for c in cameras)
    if off > TOLERANCE:
        LOG.warning(
            "%s: %s take the middle of the image for the principal point, which is up to %.1f px away",
            *(path, readers, off),
        )


def width_lost(path: Path, cameras: Sequence[Camera], readers: str) -> None:
    """Warn where readers of a file that holds the vertical field of view take a wrong horizontal one."""
    off = max(c.width / 2 * abs(c.fy / c.fx - 1) for c in cameras)
    if off > TOLERANCE:
        LOG.warning(
            "%s: %s take the vertical focal length for the horizontal one, which moves the sides by up to %.1f px",
            *(path, readers, off),
        )
