"""Define a training step as modules see it, and the base classes of a module's settings and state."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.settings import Settings, variants
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.losses.base import Comparison, Loss, LossValue
from clsplat.metrics.views import ColorFit
from clsplat.opencl.device import Array
from clsplat.photos.photographs import Photograph
from clsplat.photos.transforms import PhotographTransform, Planes
from clsplat.render.camera import DeviceCamera
from clsplat.render.rasterizer import Frame, PixelSums, Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.training.memory import max_pixels
from clsplat.training.run import Run

Tables = dict[str, NDArray[np.float32]]
Scalars = dict[str, float]


@dataclass
class TrainingStep:
    """The data of one training step.  Each hook sees the changes that earlier hooks made."""

    number: int  # global step, counted from 1
    rasterizer: Rasterizer
    photograph: Photograph
    model: DeviceModel  # the model that this step renders
    background: Array
    loss_settings: Sequence[Loss]
    transforms: Sequence[PhotographTransform]
    frame: Frame = field(init=False)
    frames: list[tuple[Rasterizer, Frame]] = field(default_factory=list)  # frames of the model and of modules
    planes: Planes = field(init=False)  # the photograph and its mask
    image: Array = field(init=False)  # image that the losses compare with the photograph; a module may replace it
    gradient: Array = field(init=False)  # gradient of the image; each `backward` replaces it with that of its input
    comparison: Comparison = field(init=False)
    transmittance_gradient: Array | None = None  # T dL/dT, [1, rows, stride]
    losses: list[LossValue] = field(default_factory=list)
    module_losses: list[LossValue] = field(default_factory=list)
    sums: PixelSums = field(init=False)
    modules: "Sequence[ModuleState]" = ()  # forward in this order, backward in reverse
    _saved: dict[int, Any] = field(default_factory=dict)

    @property
    def is_complete(self) -> bool:
        """Whether all frames had room for their pairs; otherwise, the step must be repeated.  Waits for the number."""
        return all([rasterizer.is_complete(frame) for rasterizer, frame in self.frames])

    @property
    def pixel_sums(self) -> Array:
        """The sums over each Gaussian's pixels, [PIXEL_SUMS or more, S], after the backward pass."""
        return self.sums.array

    @property
    def camera(self) -> DeviceCamera:
        return self.photograph.camera

    @property
    def view_index(self) -> int | None:
        """The index of the training view; None for other images, which modules do not change."""
        return self.photograph.camera.view_index

    @property
    def workspace(self) -> Workspace:
        return self.rasterizer.workspace

    @property
    def loss(self) -> float:
        """The sum of the losses.  Reading it waits for the device."""
        return sum(loss.value() for loss in self.losses)

    def save(self, state: "ModuleState", value: Any) -> None:
        """Save a value for later hooks of the same module in this step."""
        self._saved[id(state)] = value

    def saved_value(self, state: "ModuleState") -> Any:
        """Return the value that an earlier hook of the module saved in this step, or None."""
        return self._saved.get(id(state))


class ModuleState:
    """The state of a module during training.

    Only `update` changes scalars and tables; other hooks change only the step.  A step that
    fails before its update therefore leaves the run unchanged, and a step without room for its pairs is repeated.
    """

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "dropped"
    """Whether the state is dropped after its training stage, kept for evaluation, or active in later training too."""
    is_saved: ClassVar[bool] = True  # whether checkpoints contain the state

    def __init__(self) -> None:
        self.scalars: Scalars = {}  # values on the host, by name, with their Adam moments

    # checkpoints contain the tables and `scalars`
    def tables(self, full: bool = True) -> Tables:
        """Copy the tables to the host.  full: include the tables that only training needs, such as Adam moments."""
        return {}

    def load(self, scalars: Scalars, tables: Tables) -> None:
        """Restore the state of a checkpoint, of an earlier training run, or of the best model."""
        self.scalars = dict(scalars)

    def can_load(self, scalars: Scalars, tables: Tables) -> bool:
        """Return whether `load` accepts this state.  If not, the module starts with its initial state."""
        return True

    def start(self, run: Run) -> None:
        """Set the initial values in a run without an earlier state of this module."""

    def prepare(self, run: Run, last_step: int, is_trained: bool = True) -> None:
        """Prepare for training that ends at global step `last_step`.  is_trained: whether the module learns."""

    # hooks of a step: forward in list order, backward and update in reverse
    def before_render(self, step: TrainingStep) -> None: ...
    def after_render(self, step: TrainingStep) -> None: ...
    def before_losses(self, step: TrainingStep) -> None: ...
    def backward(self, step: TrainingStep) -> None: ...
    def after_backward(self, step: TrainingStep) -> None: ...
    def update(self, step: TrainingStep) -> None: ...

    # outside steps
    def attach_to(self, model: DeviceModel) -> None:
        """Attach objects, such as a sky, to a model, to be rendered together with its Gaussians."""

    def finish(self, run: Run) -> None:
        """Called after the last training step, before the best model replaces the model of that step."""

    @property
    def color_model(self) -> ColorFit | None:
        """The color model that metrics fit to each photograph; None to evaluate renders without color correction."""
        return None

    def apply_to(self, scene: Scene) -> Scene:
        """Return `scene`, which must be at full size, with the learned cameras."""
        return scene

    def write(self, run: Run) -> None:
        """Write the side files, and log a summary."""


class TrainingModule(Settings):
    """A component of training steps, in addition to the Gaussians."""

    order: ClassVar[int] = 0
    """Modules must be listed in ascending order of this number.  Below 20, modules change the camera, model,
    background, or photo; from 20, layers in front of the scene; from 30, colors; from 40, the compared images.
    The order is a number, not a list of modules, so that plug-ins can be ordered too."""
    side_files: ClassVar[Mapping[str, str]] = {}
    """Titles of the files that the module writes to the run folder, by file name; the names start with `view_`."""
    masks_objects: ClassVar[bool] = False  # whether it masks objects that move between photographs
    device_planes: ClassVar[int] = 0  # number of float planes on the device, each with the size of the largest view
    implicit_type: ClassVar[str] = ""  # the type of a module that is not listed but implied by the model or a loss
    keyed_by_type: ClassVar[bool] = True
    optional_on_resume: ClassVar[bool] = False  # whether a resumed run may add or remove it; results then differ

    type: str
    """Name of the module."""

    @property
    def group(self) -> str:
        """The name of the module's group.  A list may contain at most one module of each group."""
        return self.family or self.type

    @classmethod
    def implied_module(cls, run: Run, stage: Any) -> "TrainingModule | None":
        """Return the module if the run's model or the stage's losses imply it; otherwise None."""
        return None

    def resolve_auto(self, run: Run) -> "TrainingModule":
        """Return the module with its `auto` settings chosen from the photographs."""
        return self

    def is_active(self, scene: Scene | None = None) -> bool:
        """Return whether the module has an effect for a scene, or for every scene if `scene` is None."""
        return True

    def active_conflicts(self) -> Mapping[str, str]:
        return self.conflicts if self.is_active() else {}

    def check_losses(self, losses: Sequence[Loss]) -> None:
        """Raise ConfigError for losses that the module does not support."""

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        """Return an upper bound on the device memory that the module needs, in bytes.  tile: side of a tile, px."""
        return 4 * self.device_planes * max_pixels(views, tile) if self.device_planes else 0

    def check_run(self, run: Run) -> None:
        """Raise an error for a problem that can be detected before the first stage."""

    def create_state(self, run: Run) -> ModuleState:
        """Return an empty state with the sizes that the run needs, without measuring initial values."""
        raise NotImplementedError

    @classmethod
    def check_saved(cls, scalars: Scalars, tables: Tables) -> None:
        """Raise DataError if a checkpoint's scalars and tables do not fit this module."""
        for name, table in tables.items():
            if table.dtype != np.float32 or not np.isfinite(table).all():
                raise DataError(f"{name} of its {cls.__name__} has values that are not finite float32 numbers")

    @classmethod
    def read_color_model(cls, model: Path) -> ColorFit | None:
        """Read the color model of a training run from the side files next to its model.  Raises DataError."""
        return None

    @classmethod
    def apply_side_files(cls, model: Path, scene: Scene) -> Scene:
        """Return a scene with the cameras in the side files next to a model.  Raises DataError."""
        return scene


def check_list(modules: Sequence[TrainingModule]) -> None:
    """Raise ValueError if modules are out of order, or if two are in the same group."""
    for first, second in itertools.pairwise(modules):
        if second.order < first.order:
            raise ValueError(f"'{second.type}' is listed after '{first.type}'; put it before '{first.type}'")
    types: dict[str, str] = {}
    for module in modules:
        if module.group in types:
            raise ValueError(f"'{module.type}' and '{types[module.group]}' cannot be combined; remove one of them")
        types[module.group] = module.type


def attach_modules(modules: Sequence[TrainingModule], run: Run, last_step: int) -> list[ModuleState]:
    """Create the module states for training that ends at global step `last_step`, and return them in order.

    There is a state for each listed module, for each module that the model or the losses imply, and for each module of
    an earlier training run that is still active.
    """
    new_modules = [module for module in (*implied_modules(run), *modules) if module.is_active(run.scene)]
    groups = {module.group for module in new_modules}
    earlier_modules = [m for m in modules_so_far(run).values() if m.type in run.modules and m.group not in groups]
    active_modules = [module for module in earlier_modules if run.modules[module.type].after_training == "active"]
    states, old_states = list[ModuleState](), run.modules
    run.modules = {module.type: old_states[module.type] for module in earlier_modules}
    for module in sorted([*new_modules, *active_modules], key=lambda module: module.order):
        state, old_state = module.create_state(run), old_states.get(module.type)
        if old_state and old_state is not state and state.can_load(old_state.scalars, tables := old_state.tables()):
            state.load(old_state.scalars, tables)
        elif old_state is not state:
            state.start(run)
        state.prepare(run, last_step, module in new_modules)
        if state.is_saved:
            run.modules[module.type] = state
        states.append(state)
    return states


def modules_so_far(run: Run) -> dict[str, TrainingModule]:
    """Return the modules of a run's stages up to the current stage, by type: the last module of each type."""
    stages = getattr(run.settings, "stages", ())[: run.stage_index + 1]
    modules = (module for stage in stages for module in getattr(stage, "modules", ()))
    return {module.type: module for module in (*modules, *implied_modules(run)) if module.is_active(run.scene)}


def implied_modules(run: Run, stage: Any = None) -> list[TrainingModule]:
    """Return the modules that the model and the losses of a stage imply.  stage: None for the current stage."""
    stages = getattr(run.settings, "stages", ())
    stage = stages[run.stage_index] if stage is None and run.stage_index < len(stages) else stage
    return [module for cls in implicit_modules().values() if (module := cls.implied_module(run, stage))]


def implicit_modules() -> dict[str, type[TrainingModule]]:
    """Return the classes of modules that are only implied, never listed in a pipeline, by type."""
    return {
        module.implicit_type: module
        for module in Settings.subclasses
        if issubclass(module, TrainingModule) and module.implicit_type
    }


def restore_modules(run: Run, saved: Mapping[str, tuple[Scalars, Tables]]) -> dict[str, ModuleState]:
    """Return the module states of a checkpoint, by type."""
    modules, states = modules_so_far(run), dict[str, ModuleState]()
    for name, (scalars, tables) in saved.items():
        if module := modules.get(name):
            states[name] = module.create_state(run)
            states[name].load(scalars, tables)
    return states


def learned_scene(run: Run) -> Scene:
    """Return the full-size scene of a run with the cameras that its modules learned."""
    scene = run.original
    for state in run.modules.values():
        scene = state.apply_to(scene)
    return scene


def apply_side_files(model: Path, scene: Scene) -> Scene:
    """Return a scene with the cameras in the side files next to a model."""
    for cls in variants(TrainingModule).values():
        scene = cls.apply_side_files(model, scene)
    return scene


def module_class(name: str) -> type[TrainingModule]:
    """Return the class of a module in a checkpoint.  Raises ConfigError for an unknown name."""
    if (cls := {**variants(TrainingModule), **implicit_modules()}.get(name)) is None:
        raise ConfigError(f"the checkpoint has an unknown module '{name}'; load its plug-in with --plugin")
    return cls


def color_model(run: Run) -> ColorFit | None:
    """Return the color model that metrics fit to each photograph; None to evaluate renders without color correction."""
    return next((model for state in run.modules.values() if (model := state.color_model)), None)


def read_color_model(model: Path) -> ColorFit | None:
    """Read the color model of a training run from the side files next to its model.  Raises DataError."""
    models = (cls.read_color_model(model) for cls in variants(TrainingModule).values())
    return next((model for model in models if model), None)
