"""Export the names that plug-ins may import: base classes, and the types in their signatures.

Other modules of clsplat may change between versions, but the names in this module are stable.  No other module of
clsplat imports it.
"""

from clsplat.core.errors import (
    ClsplatError,
    ConfigError,
    DataError,
    DeviceError,
    MemoryLimitError,
    NumericError,
    OutputError,
)
from clsplat.core.reading import read_file
from clsplat.core.schedule import AtLeastOne, Curve, NonNegative, Positive, Schedule, at_step
from clsplat.core.settings import OneOf, Settings, variants
from clsplat.density.edit import Edit, Rule
from clsplat.density.statistics import Statistic
from clsplat.gaussians.gaussians import Gaussians
from clsplat.gaussians.structs import GaussianGradients
from clsplat.losses.base import Comparison, ImageLoss, LossValue, Penalty, PenaltyInputs, ViewGradients
from clsplat.opencl.device import Array, Device
from clsplat.photos.appearance import Floats, ViewTable
from clsplat.photos.sampling import Order, ViewPool
from clsplat.photos.transforms import PhotographTransform, Planes
from clsplat.pipeline.adapt import Adaptation, Decision
from clsplat.prepare.steps import Step
from clsplat.render.camera import DeviceCamera
from clsplat.render.filters import FilterViews, ScreenFilter, WorldFilter
from clsplat.render.workspace import Workspace
from clsplat.scene.camera import Camera
from clsplat.scene.colmap import pose_matrix
from clsplat.scene.lookup import require_files, safe_join
from clsplat.scene.quality import Measures
from clsplat.scene.reader import Reader
from clsplat.scene.scene import PointCloud, Scene, every_nth, make_scene
from clsplat.scene.view import View
from clsplat.stages.optimize import Optimize
from clsplat.training.modules.base import ModuleState, Scalars, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled, Stage, path_in_run

__all__ = [
    "Adaptation",
    "Array",
    "AtLeastOne",
    "Camera",
    "ClsplatError",
    "Comparison",
    "ConfigError",
    "Curve",
    "DataError",
    "Decision",
    "Device",
    "DeviceCamera",
    "DeviceError",
    "Edit",
    "FilterViews",
    "Floats",
    "GaussianGradients",
    "Gaussians",
    "ImageLoss",
    "LossValue",
    "Measures",
    "MemoryLimitError",
    "ModuleState",
    "NonNegative",
    "NumericError",
    "OneOf",
    "Optimize",
    "Order",
    "OutputError",
    "Penalty",
    "PenaltyInputs",
    "PhotographTransform",
    "Planes",
    "PointCloud",
    "Positive",
    "Reader",
    "Rule",
    "Run",
    "Scalars",
    "Scene",
    "Schedule",
    "Scheduled",
    "ScreenFilter",
    "Settings",
    "Stage",
    "Statistic",
    "Step",
    "Tables",
    "TrainingModule",
    "TrainingStep",
    "View",
    "ViewGradients",
    "ViewPool",
    "ViewTable",
    "Workspace",
    "WorldFilter",
    "at_step",
    "every_nth",
    "make_scene",
    "path_in_run",
    "pose_matrix",
    "read_file",
    "require_files",
    "safe_join",
    "variants",
]
