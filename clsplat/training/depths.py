"""The depths that a training knows, where a loss reads them."""

from collections.abc import Sequence
from pathlib import Path

from clsplat.errors import ConfigError, DataError
from clsplat.losses.base import Loss
from clsplat.losses.depth import InverseDepth
from clsplat.training.run import Run
from clsplat.views.depth_maps import DepthMaps
from clsplat.views.known_depths import PointDepths
from clsplat.views.photograph_poses import PhotographPoses


def known_depths(losses: Sequence[Loss], run: Run, poses: PhotographPoses | None) -> PointDepths | None:
    """Return the depths of the points that each training photograph shows; None where no loss reads them.

    Raises DataError where nothing tells which photographs show a point, ConfigError where poses are learned, or where
    two losses name different folders.
    """
    folders = {loss.folder for loss in losses if isinstance(loss, InverseDepth)}
    if not folders:
        return None
    if len(folders) > 1:
        raise ConfigError("the loss 'inverse_depth' is given with two folders; expected one loss of it, or one folder")
    if poses:
        raise ConfigError(
            "the loss 'inverse_depth' does not go with optimize.poses, which it would not move; leave one of them out"
        )
    if run.scene.tracks is None:
        raise DataError(
            f"{run.scene.path}: nothing tells which photographs show a point, which the loss 'inverse_depth' needs; "
            "expected a COLMAP model with points: leave the loss out"
        )
    names = [view.name for view in run.scene.split("train")]
    folder = folders.pop()
    maps = DepthMaps(Path(folder)) if folder else None
    return PointDepths(run.device, run.scene.tracks, names, run.scene.extent, maps)
