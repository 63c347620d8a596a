"""The depths that a training knows, where a loss reads them."""

from collections.abc import Sequence
from pathlib import Path

from clsplat.core.errors import ConfigError, DataError
from clsplat.losses.base import Loss
from clsplat.losses.depth import InverseDepth
from clsplat.photos.depths import DepthMaps, PointDepths
from clsplat.scene.reprojection import within
from clsplat.scene.scene import Scene
from clsplat.training.modules.camera_optimizer import PhotographPoses
from clsplat.training.run import Run


def known_depths(losses: Sequence[Loss], run: Run, poses: PhotographPoses | None) -> PointDepths | None:
    """Return the depths of the points that each training photograph shows; None where no loss reads them.

    Raises what `require_depths` raises.
    """
    require_depths(losses, run.scene, poses=bool(poses))
    folders = _folders(losses)
    if not folders or run.scene.tracks is None:
        return None
    views = run.scene.split("train")
    tracks, names = within(run.scene.tracks, views), [view.name for view in views]
    return PointDepths(run.device, tracks, names, run.scene.extent, _maps(folders))


def require_depths(losses: Sequence[Loss], scene: Scene, poses: bool) -> None:
    """Raise DataError where nothing tells which photographs show a point, or one has no depth map, ConfigError where
    poses are learned, or where two losses name different folders; nothing where no loss reads depths."""
    folders = _folders(losses)
    if not folders:
        return
    if len(folders) > 1:
        raise ConfigError("the loss 'inverse_depth' is given with two folders; expected one loss of it, or one folder")
    if poses:
        raise ConfigError(
            "the loss 'inverse_depth' does not go with optimize.poses, which it would not move; leave one of them out"
        )
    if scene.tracks is None:
        raise DataError(
            f"{scene.path}: nothing tells which photographs show a point, which the loss 'inverse_depth' needs; "
            "expected a COLMAP model with points: leave the loss out"
        )
    if maps := _maps(folders):
        maps.require(view.name for view in scene.split("train"))


def _maps(folders: set[str | None]) -> DepthMaps | None:
    """The maps in the one folder that is named; None: points alone."""
    (folder,) = folders
    return DepthMaps(Path(folder)) if folder else None


def _folders(losses: Sequence[Loss]) -> set[str | None]:
    """The folders of depth maps that losses name; None: points alone."""
    return {loss.folder for loss in losses if isinstance(loss, InverseDepth)}
