"""The stages that a pipeline file can name."""

from clsplat.stages.base import Stage
from clsplat.stages.checkpoint import Checkpoint
from clsplat.stages.densify import Densify
from clsplat.stages.evaluate import Evaluate
from clsplat.stages.export import Export
from clsplat.stages.init import Init
from clsplat.stages.optimize import Optimize
from clsplat.stages.render import Render
from clsplat.stages.report import Report
from clsplat.stages.schedule import RaiseSh, RefreshFilter, ResetOpacity

STAGES: dict[str, type[Stage]] = {
    "init": Init,
    "optimize": Optimize,
    "densify": Densify,
    "raise_sh": RaiseSh,
    "reset_opacity": ResetOpacity,
    "refresh_filter": RefreshFilter,
    "checkpoint": Checkpoint,
    "evaluate": Evaluate,
    "render": Render,
    "export": Export,
    "report": Report,
}
AnyStage = (
    Init
    | Optimize
    | Densify
    | RaiseSh
    | ResetOpacity
    | RefreshFilter
    | Checkpoint
    | Evaluate
    | Render
    | Export
    | Report
)
