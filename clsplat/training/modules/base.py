"""A training step as modules see it, and what a module is: settings in a pipeline file, and a state in a training."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.settings import Settings, variants
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.gaussians.model import Model
from clsplat.losses.base import Comparison, Loss, LossValue
from clsplat.metrics.views import Fitted
from clsplat.opencl.device import Array
from clsplat.photos.photographs import Photograph
from clsplat.photos.transforms import PhotographTransform, Planes
from clsplat.render.camera import DeviceCamera
from clsplat.render.filters import ModelSettings
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.render.workspace import Workspace
from clsplat.scene.scene import Scene
from clsplat.scene.view import View
from clsplat.training.memory import most_pixels
from clsplat.training.run import Run

Tables = dict[str, NDArray[np.float32]]
Numbers = dict[str, float]


@dataclass
class TrainingStep:
    """One training step while it is done; each hook finds what those before it have left."""

    number: int  # global, from 1
    rasterizer: Rasterizer
    photograph: Photograph
    model: DeviceModel  # as it is drawn
    background: Array
    losses_asked: Sequence[Loss]
    transforms: Sequence[PhotographTransform]
    frame: Frame = field(init=False)
    planes: Planes = field(init=False)  # the photograph, and which pixels count
    image: Array = field(init=False)  # what the losses compare with it; a module puts another in its place
    gradient: Array = field(init=False)  # by the image; in the backward pass by what it was before the module
    comparison: Comparison = field(init=False)
    behind: Array | None = None  # T dL/dT, [1, rows, stride]
    losses: list[LossValue] = field(default_factory=list)
    own_losses: list[LossValue] = field(default_factory=list)  # of modules
    pixel_sums: Array = field(init=False)
    skipped: bool = False
    modules: "Sequence[ModuleState]" = ()  # that take part: forward in this order, backward in reverse
    _kept: dict[int, Any] = field(default_factory=dict)

    @property
    def camera(self) -> DeviceCamera:
        return self.photograph.camera

    @property
    def view(self) -> int | None:
        """The number of the training view; None for another picture, which no module changes."""
        return self.photograph.camera.view

    @property
    def workspace(self) -> Workspace:
        return self.rasterizer.workspace

    @property
    def loss(self) -> float:
        """The sum of the losses; waits for the device."""
        return sum(loss.value() for loss in self.losses)

    def keep(self, state: "ModuleState", value: Any) -> None:
        """Keep what a later hook of the same module needs, for this step alone."""
        self._kept[id(state)] = value

    def kept(self, state: "ModuleState") -> Any:
        return self._kept.get(id(state))


class ModuleState:
    """A module in a training.  Hooks up to `after_backward` change the step and nothing else; `update` alone changes
    numbers and tables, so that a failure before it leaves the run at the step before."""

    outlasts: str = "no"  # as its module says
    is_saved: ClassVar[bool] = True  # in checkpoints

    def __init__(self) -> None:
        self.numbers: Numbers = {}  # on the host, by name, with their moments

    # what a checkpoint holds
    def tables(self, whole: bool = True) -> Tables:
        """Copy its tables to the host.  whole: with what only training needs, such as moments."""
        return {}

    def load(self, numbers: Numbers, tables: Tables) -> None:
        """Take what a checkpoint, an earlier training or the best model holds."""
        self.numbers = dict(numbers)

    def takes(self, numbers: Numbers, tables: Tables) -> bool:
        """Whether `load` can go on from it; else the module begins anew."""
        return True

    def begin(self, run: Run) -> None:
        """Set the first values, where a run has none."""

    def prepare(self, run: Run, last: int, trained: bool = True) -> None:
        """Come to the beginning of a training up to a global step.  trained: False: it acts, and learns no more."""

    # in a step: forward in the order of the list, backward in reverse
    def before_render(self, step: TrainingStep) -> None: ...
    def after_render(self, step: TrainingStep) -> None: ...
    def before_losses(self, step: TrainingStep) -> None: ...
    def after_losses(self, step: TrainingStep) -> None: ...
    def backward(self, step: TrainingStep) -> None: ...
    def after_backward(self, step: TrainingStep) -> None: ...
    def update(self, step: TrainingStep) -> None: ...
    def update_skipped(self, step: TrainingStep) -> None: ...

    # outside steps
    def complete(self, model: DeviceModel) -> None:
        """Give a model what it is drawn with besides its Gaussians."""

    def finish(self, run: Run) -> None:
        """At the last step, before a better model than that of the last step is put back."""

    @property
    def measured_as(self) -> Fitted | None:
        """What images are fitted with to be measured in the colors of their photographs; None: they are not."""
        return None

    def scene(self, scene: Scene) -> Scene:
        """Return a scene, at its full size, with what was learned of its cameras."""
        return scene

    def write(self, run: Run) -> None:
        """Write the side files, and log a line."""


class TrainingModule(Settings):
    """Something that takes part in a training step next to the Gaussians."""

    place: ClassVar[int] = 0
    """In the list: modules stand in ascending order of it.  Those below 20 change the camera, the model, the background
    or the photograph; those below 30 what stands in front of the scene, below 40 colors, below 99 what is compared.  It
    is a number, not names of other modules, so that one that no other knows has its place too."""
    outlasts: ClassVar[Literal["no", "numbers", "acts"]] = "no"
    """What outlasts its training: its numbers, for measurements; or it acts in later trainings too."""
    files: ClassVar[Mapping[str, str]] = {}  # side files in the run folder, which begin with `view_`, and their titles

    planes: ClassVar[int] = 0  # of floats on the device, of the largest view's size

    brought_as: ClassVar[str] = ""  # its type, where no list names it: the model, a loss or the views bring it
    measure: ClassVar[str | None] = None  # the field of `Measures` that `measured` returns
    by_type: ClassVar[bool] = True
    joins: ClassVar[bool] = False  # a run may go on with it, or without it; bits then no longer compare

    type: str
    """Name of the module."""

    @property
    def kin(self) -> str:
        """What modules that exclude each other have in common."""
        return self.family or self.type

    @classmethod
    def brought(cls, run: Run, stage: Any) -> "TrainingModule | None":
        """Return it where the model of a run, or a stage, brings it, though no list names it."""
        return None

    @classmethod
    def measured(cls, run: Run) -> float | None:
        """Return a number that settings depend on; None where it is not known."""
        return None

    @classmethod
    def settled_model(cls, run: Run, settings: ModelSettings, modules: "Sequence[TrainingModule]") -> ModelSettings:
        """Return settings of a model with what follows from the photographs; modules: of the trainings."""
        return settings

    @classmethod
    def begin_model(cls, run: Run, source: Model | None) -> None:
        """Begin what a new model of a run is to have; source: what it was made of, if a model."""

    @classmethod
    def advice(cls, run: Run) -> Iterator[str]:
        """Yield sentences for the page of a run."""
        yield from ()

    def settled(self, run: Run) -> "TrainingModule":
        """Return it with what follows from the photographs."""
        return self

    def is_active(self, scene: Scene | None = None) -> bool:
        """Whether it does anything with the photographs of a scene; without one, whether it does with any."""
        return True

    def excluded(self) -> Mapping[str, str]:
        return self.conflicts if self.is_active() else {}

    def check_losses(self, losses: Sequence[Loss]) -> None:
        """Raise ConfigError for losses that it does not go with."""

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        """Return what it takes on the device at most.  tile: px of its sides."""
        return 4 * self.planes * most_pixels(views, tile) if self.planes else 0

    def check_in(self, run: Run) -> None:
        """Raise errors that can be known before the first stage."""

    def state(self, run: Run) -> ModuleState:
        """Return its state without any value: sizes follow from the run, nothing is measured."""
        raise NotImplementedError

    @classmethod
    def check_saved(cls, numbers: Numbers, tables: Tables) -> None:
        """Raise DataError for what is not of such a module."""
        for name, table in tables.items():
            if table.dtype != np.float32 or not np.isfinite(table).all():
                raise DataError(f"{name} of its {cls.__name__} is not of finite numbers")

    @classmethod
    def measured_beside(cls, model: Path) -> Fitted | None:
        """Return what `measured_as` was where a model was trained, by side files next to it.  Raises DataError."""
        return None

    @classmethod
    def beside(cls, model: Path, scene: Scene) -> Scene:
        """Return a scene with what lies in side files beside a model."""
        return scene


def check_list(modules: Sequence[TrainingModule]) -> None:
    """Raise ValueError for modules out of order, or of which two have the same kin."""
    kin = [one.kin for one in modules]
    for before, after in itertools.pairwise(modules):
        if after.place < before.place:
            raise ValueError(f"'{after.type}' stands after '{before.type}'; expected it before that")
    for i, one in enumerate(modules):
        if (first := kin.index(one.kin)) < i:
            raise ValueError(f"'{one.type}' and '{modules[first].type}' exclude each other; leave one out")


def attached(modules: Sequence[TrainingModule], run: Run, last: int) -> list[ModuleState]:
    """Return the states of a training up to a global step, in order: those of its list, and those that act on."""
    listed = [(one, True) for one in (*brought(run), *modules) if one.is_active(run.scene)]
    kin = {one.kin for one, _ in listed}
    earlier = [one for one in modules_of(run).values() if one.type in run.modules and one.kin not in kin]
    listed += [(one, False) for one in earlier if one.outlasts == "acts"]
    states, before = list[ModuleState](), run.modules
    run.modules = {one.type: before[one.type] for one in earlier}
    for module, trained in sorted(listed, key=lambda one: one[0].place):
        state, old = state_of(module, run), before.get(module.type)
        if old and old is not state and state.takes(old.numbers, tables := old.tables()):
            state.load(old.numbers, tables)
        elif old is not state:
            state.begin(run)
        state.prepare(run, last, trained)
        if state.is_saved:
            run.modules[module.type] = state
        states.append(state)
    return states


def state_of(module: TrainingModule, run: Run) -> ModuleState:
    state = module.state(run)
    state.outlasts = module.outlasts
    return state


def modules_of(run: Run) -> dict[str, TrainingModule]:
    """The modules of a run's trainings so far, by type: the last of each."""
    stages = getattr(run.settings, "stages", ())[: run.cursor + 1]
    listed = (module for stage in stages for module in getattr(stage, "modules", ()))
    return {module.type: module for module in (*listed, *brought(run)) if module.is_active(run.scene)}


def brought(run: Run, stage: Any = None) -> list[TrainingModule]:
    """Return the modules that no list names, of a stage; None: of that in progress."""
    stages = getattr(run.settings, "stages", ())
    stage = stages[run.cursor] if stage is None and run.cursor < len(stages) else stage
    return [module for kind in unlisted().values() if (module := kind.brought(run, stage))]


def unlisted() -> dict[str, type[TrainingModule]]:
    """Return the classes of modules that no list names, by what they are brought as."""
    return {one.brought_as: one for one in Settings.defined if issubclass(one, TrainingModule) and one.brought_as}


def restored(run: Run, saved: Mapping[str, tuple[Numbers, Tables]]) -> dict[str, ModuleState]:
    """Return the states of a checkpoint, by type."""
    modules, found = modules_of(run), dict[str, ModuleState]()
    for name, (numbers, tables) in saved.items():
        if module := modules.get(name):
            found[name] = state_of(module, run)
            found[name].load(numbers, tables)
    return found


def learned_scene(run: Run) -> Scene:
    """Return the scene of a run, at its full size, with what its modules have learned of cameras."""
    scene = run.original
    for state in run.modules.values():
        scene = state.scene(scene)
    return scene


def scene_beside(model: Path, scene: Scene) -> Scene:
    """Return a scene with what lies in the side files of modules next to a model."""
    for kind in variants(TrainingModule).values():
        scene = kind.beside(model, scene)
    return scene


def kind_of(name: str) -> type[TrainingModule]:
    """Return the class of a checkpoint's module.  Raises ConfigError for one that is not known."""
    if (kind := {**variants(TrainingModule), **unlisted()}.get(name)) is None:
        raise ConfigError(f"the checkpoint has a module '{name}', which is not known; give its --plugin")
    return kind


def measured_as(run: Run) -> Fitted | None:
    """Return what images are fitted with to be measured in the colors of their photographs; None: they are not."""
    return next((fitted for state in run.modules.values() if (fitted := state.measured_as)), None)


def measured_beside(model: Path) -> Fitted | None:
    """Return the same of a training by its side files next to a model.  Raises DataError where one is damaged."""
    found = (kind.measured_beside(model) for kind in variants(TrainingModule).values())
    return next((fitted for fitted in found if fitted), None)
