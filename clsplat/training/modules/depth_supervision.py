"""The depths that a training knows, where a loss reads them."""

from collections.abc import Sequence
from pathlib import Path

from clsplat.core.errors import ConfigError, DataError
from clsplat.losses.base import Loss
from clsplat.losses.depth import InverseDepth
from clsplat.photos.depths import DepthMaps, PointDepths
from clsplat.scene.quality import within
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import ModuleState, Step
from clsplat.training.run import Run


class KnownDepthsState(ModuleState):
    """The known depths in a step.  The loss brings them: no list names them."""

    def __init__(self, depths: PointDepths) -> None:
        super().__init__()
        self.depths = depths

    @classmethod
    def of(cls, losses: Sequence[Loss], run: Run) -> "list[KnownDepthsState]":
        found = known_depths(losses, run)
        return [cls(found)] if found else []

    def before_losses(self, step: Step) -> None:
        step.comparison.depths = self.depths.at(step.camera)


def known_depths(losses: Sequence[Loss], run: Run) -> PointDepths | None:
    """Return the depths of the points that each training photograph shows; None where no loss reads them.

    Raises what `require_depths` raises.
    """
    require_depths(losses, run.scene)
    folders = _folders(losses)
    if not folders or run.scene.tracks is None:
        return None
    views = run.scene.split("train")
    tracks, names = within(run.scene.tracks, views), [view.name for view in views]
    return PointDepths(run.device, tracks, names, run.scene.extent, _maps(folders))


def require_depths(losses: Sequence[Loss], scene: Scene) -> None:
    """Raise DataError where nothing tells which photographs show a point, or one has no depth map, ConfigError where
    two losses name different folders; nothing where no loss reads depths."""
    folders = _folders(losses)
    if not folders:
        return
    if len(folders) > 1:
        raise ConfigError("the loss 'inverse_depth' is given with two folders; expected one loss of it, or one folder")
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
