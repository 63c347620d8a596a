"""Supply known depths to the loss `inverse_depth`."""

from pathlib import Path
from typing import Any, ClassVar

from clsplat.core.errors import ConfigError, DataError
from clsplat.losses.depth import InverseDepth
from clsplat.photos.depths import DepthMaps, PointDepths
from clsplat.scene.reprojection import filter_tracks
from clsplat.training.modules.base import ModuleState, TrainingModule, TrainingStep
from clsplat.training.run import Run


class DepthSupervision(TrainingModule):
    """A module that supplies known depths to the loss `inverse_depth`, which implies it."""

    implicit_type: ClassVar[str] = "depth_supervision"
    order: ClassVar[int] = -10

    losses: list[Any]

    @classmethod
    def implied_module(cls, run: Run, stage: Any) -> "DepthSupervision | None":
        losses = [loss for loss in getattr(stage, "losses", ()) if isinstance(loss, InverseDepth)]
        return cls(type=cls.implicit_type, losses=losses) if losses else None

    def check_run(self, run: Run) -> None:
        """Raise DataError if tracks or a depth map are missing; ConfigError if the losses name different folders."""
        if len({loss.folder for loss in self.losses}) > 1:
            raise ConfigError("the loss 'inverse_depth' is listed with two folders; keep only one of them")
        if run.scene.tracks is None:
            raise DataError(
                f"{run.scene.path}: the loss 'inverse_depth' needs points with tracks, as in a COLMAP model; "
                "remove the loss, or use a COLMAP dataset"
            )
        if self._maps:
            self._maps.require(view.name for view in run.scene.split("train"))

    @property
    def _maps(self) -> DepthMaps | None:
        """The depth maps; None if the losses use only points."""
        folder = self.losses[0].folder
        return DepthMaps(Path(folder)) if folder else None

    def create_state(self, run: Run) -> "DepthSupervisionState":
        self.check_run(run)
        assert run.scene.tracks is not None
        views = run.scene.split("train")
        tracks, names = filter_tracks(run.scene.tracks, views), [view.name for view in views]
        return DepthSupervisionState(PointDepths(run.device, tracks, names, run.scene.extent, self._maps))


class DepthSupervisionState(ModuleState):
    """The known depths of the training views."""

    is_saved: ClassVar[bool] = False

    def __init__(self, depths: PointDepths) -> None:
        super().__init__()
        self.depths = depths

    def before_losses(self, step: TrainingStep) -> None:
        step.comparison.depths = self.depths.at(step.camera)
