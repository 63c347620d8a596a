"""The depths that a training knows, where a loss reads them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

from clsplat.core.errors import ConfigError, DataError
from clsplat.losses.base import Loss
from clsplat.losses.depth import InverseDepth
from clsplat.photos.depths import DepthMaps, PointDepths
from clsplat.scene.reprojection import within
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run


class DepthSupervision(TrainingModule):
    """The depths that a loss reads.  The loss brings it: no list names it."""

    brought_as: ClassVar[str] = "depth_supervision"
    place: ClassVar[int] = -10

    losses: list[Any]

    @classmethod
    def brought(cls, run: Run, stage: Any) -> "DepthSupervision | None":
        losses = [loss for loss in getattr(stage, "losses", ()) if isinstance(loss, InverseDepth)]
        return cls(type=cls.brought_as, losses=losses) if losses else None

    def check_in(self, run: Run) -> None:
        require_depths(self.losses, run.scene)

    def state(self, run: Run) -> "KnownDepthsState":
        return KnownDepthsState(known_depths(self.losses, run))


class KnownDepthsState(ModuleState):
    """The known depths in a step."""

    is_saved: ClassVar[bool] = False

    def __init__(self, depths: PointDepths | None) -> None:
        super().__init__()
        self.depths = depths

    def before_losses(self, step: TrainingStep) -> None:
        if self.depths:
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
