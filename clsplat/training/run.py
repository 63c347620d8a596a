"""The state of a pipeline while it runs."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError
from clsplat.core.progress import Progress, Stopped
from clsplat.core.resources import __version__
from clsplat.core.settings import Settings
from clsplat.density.statistics import SplatStats
from clsplat.density.survey import Survey
from clsplat.gaussians.gaussians import HIDDEN, INTERVAL2, DeviceModel
from clsplat.gaussians.model import Model, Rendering
from clsplat.losses.base import Loss
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photographs, texture_quantile
from clsplat.render.filters import FilterViews, ModelSettings, measure_intervals
from clsplat.render.painter import Painter, SplatPainter
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.scene.identity import Identity
from clsplat.scene.scene import Scene, scene_name
from clsplat.training.adam import Adam
from clsplat.training.best_model import Best, Tables
from clsplat.training.field import TrainedField
from clsplat.training.memory import SEEN_SHARE, Harmonics, MemoryPlan, Where, bytes_of_modules, most_pixels, plan
from clsplat.training.records import Records, clocks
from clsplat.training.status import StatusFile

Item = TypeVar("Item")


@dataclass
class Run:
    """The mutable state of a pipeline; stages read and change it."""

    device: Device
    scene: Scene  # as trained on: at one size or several
    original: Scene  # as read
    out: Path
    name: str
    seed: int
    settings: Settings  # of the pipeline
    pipeline: dict[str, Any]  # the same, resolved, as written to pipeline.yaml
    rasterizer: Rasterizer
    photographs: Photographs
    status: StatusFile
    model_settings: ModelSettings
    harmonics: Harmonics = "device"  # the memory in which those above band 0 lie while they are trained
    identity: Identity | None = None  # of the original scene and its photographs
    read: dict[str, str] = field(default_factory=dict)  # hashes of the files that settings name, by their text
    prepared: dict[str, str] | None = None  # hash of the inputs of `prepare:`, and the folder of its result
    found: dict[str, dict[str, Any]] = field(default_factory=dict)  # by the steps of `prepare:`
    losses: list[Loss] = field(default_factory=list)  # added from Python, beside those of the pipeline
    adam: Adam | None = None
    stats: SplatStats | None = None
    modules: dict[str, Any] = field(default_factory=dict)  # states of its trainings' modules, by name
    learned_field: TrainedField | None = None  # in the place of a model
    step: int = 0  # updates done, or in progress
    cursor: int = 0  # stage in progress
    stage_step: int = 0  # steps done in it
    acted: int = 0  # stages of its `during` that have acted since that step
    edited: bool = False  # whether those that edit the model have too
    whole: bool = True  # False after a failure in the middle of a change of the tables
    changes: list[str] = field(default_factory=list)  # of settings, with which the run went on
    divisor: float = 1.0  # of the photographs' size at the step before an edit
    inputs_before: str = ""  # `inputs` of the checkpoint that the run goes on from
    scalars: dict[str, float] = field(default_factory=dict)  # that parts of it keep from step to step, by name
    best: Best | None = None  # what validation has found in the training
    best_tables: Tables = field(default_factory=dict)  # of that model, on the host, as long as the training goes on
    measured: dict[Any, Any] = field(default_factory=dict)  # what modules have measured once, by keys of their choice
    train_seconds: float = 0.0
    cpu_seconds: float = 0.0  # of all threads of the process, in the same time
    written: dict[str, str] = field(default_factory=dict)  # models: path in the run folder -> SHA-256
    metrics: dict[str, dict[str, Any]] = field(default_factory=dict)  # split -> downscale -> averages
    interrupted: bool = False  # finish the step, save, stop
    show: Callable[[Progress], None] = lambda progress: None
    between: Callable[[], None] = lambda: None  # between two steps, or items of a long stage; it reads, and may wait

    def __post_init__(self) -> None:
        self.records = Records(self.out, self.status.require_held)
        self._model: DeviceModel | None = None
        self._filter_views: FilterViews | None = None
        self._texture_quantiles: dict[float, float] = {}

    @property
    def model(self) -> DeviceModel:
        """The model.  Raises ConfigError when no stage has made one."""
        if self._model is None:
            raise ConfigError("no model yet: an init stage must come first")
        for state in self.modules.values():
            state.attach_to(self._model)
        return self._model

    @model.setter
    def model(self, model: DeviceModel) -> None:
        self._model, self.learned_field = model, None

    def painter(self, rasterizer: Rasterizer | None = None) -> Painter:
        """Return what renders views, with another rasterizer than the training's.  Raises ConfigError as `model`."""
        if self.learned_field:
            return self.learned_field.painter
        return SplatPainter(rasterizer or self.rasterizer, self.model, self.photographs.background)

    @property
    def gaussians(self) -> int | None:
        """The number of Gaussians; None where a field is trained."""
        return None if self.learned_field else self.model.gaussians.count

    def not_finite(self) -> list[str]:
        """Return the names of what is trained that holds NaN or infinity."""
        return self.learned_field.not_finite() if self.learned_field else self.model.gaussians.not_finite()

    def next_stage(self, cursor: int) -> None:
        """Come to the beginning of a stage."""
        self.cursor, self.stage_step, self.acted, self.edited = cursor, 0, 0, False
        self.records.settled = self.records.lines
        self.modules = {name: one for name, one in self.modules.items() if one.after_training != "dropped"}
        if self._model is not None:
            self.model.gaussians.tables.pop(HIDDEN, None)  # which a training has for itself

    @property
    def model_step(self) -> int:
        """The global step whose model this is."""
        is_kept = self.best is not None and self.best.taken == self.step and self.best.refit != "begun"
        return self.best.found.step if self.best and is_kept else self.step

    @property
    def is_refit(self) -> bool:
        """Whether all training photographs are trained on, those for validation too, for the steps that were best."""
        return self.best is not None and self.best.refit == "begun"

    def begin_again(self, best: Best) -> None:
        """Come to the beginning of the pipeline, to train again for the steps of the best model."""
        self._model = None
        self.adam = self.stats = None
        self.modules = {}
        self.scalars = {}
        self.metrics = {}
        self.written = {}
        self.whole = True
        self.step = 0
        self.divisor = 1.0
        self.best = best
        self.best_tables = {}
        self.next_stage(0)
        self.divide(self.original.with_fold())

    def divide(self, original: Scene) -> None:
        """Take the scene, as it was read, with another split of its views."""
        self.original, self.scene = original, original.downscaled(*self.scene.downscales)
        self._filter_views, self._texture_quantiles = None, {}

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Change the tables in the block: where it fails they are neither those before nor those after it."""
        before, self.whole = self.whole, False
        yield
        self.whole = before

    def add_training_time(self, start: tuple[float, float]) -> float:
        """Count what the clocks show since `start` as training; return the seconds of the first."""
        spent, cpu = (now - then for now, then in zip(clocks(), start, strict=True))
        self.train_seconds += spent
        self.cpu_seconds += cpu
        return spent

    @property
    def scene_name(self) -> str:
        """What pages call the scene."""
        return scene_name(self.pipeline["scene"]["path"] or self.scene.path)

    @property
    def inputs(self) -> str:
        """A hash of the photographs, cameras and points; "" where they were not looked at."""
        return self.identity.digest if self.identity else ""

    @property
    def has_model(self) -> bool:
        """Whether there is a model or a field, which a checkpoint can hold."""
        return self._model is not None or self.learned_field is not None

    def until_interrupted(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items of a long stage; raise Stopped between two of them when the run is to stop."""
        for item in items:
            if self.interrupted:
                raise Stopped("stopped")
            self.between()
            yield item

    @property
    def downscale(self) -> float:
        """The smallest divisor of the photographs' size in training."""
        return self.scene.downscales[0]

    def memory_plan(
        self,
        components: Mapping[str, int] | None = None,
        harmonics: Where | None = None,
        seen: float = SEEN_SHARE,
    ) -> MemoryPlan:
        """Return the plan of the device's memory for training with the present tables, or those of `components`.

        harmonics: where they lie; None: where they are now; seen: as for `plan`.
        """
        if harmonics is None:
            harmonics = "host" if self.model.gaussians.on_host else "device"
        components = components or self.model.gaussians.components
        views, tile = self.scene.split("train"), int(self.device.tuning["TILE"])
        bytes_held = min(self.photographs.budget, sum(4 * view.camera.width * view.camera.height for view in views))
        bytes_held += bytes_of_modules(getattr(self.settings, "stages", ()), views, tile)
        pixels = most_pixels(views, tile)
        pixel_sums = PIXEL_SUMS if self.stats is None else self.stats.pixel_sums
        return plan(self.device.info, components, bytes_held, pixels, pixel_sums, harmonics, seen)

    def refresh_filter(self) -> None:
        """Update the world filter and the sampling intervals to the present Gaussians."""
        if self._filter_views is None:
            self._filter_views = FilterViews(self.device, self.scene.split("train"))
        model, views = self.model, self._filter_views
        self.model_settings.world_filter.refresh(model.gaussians, views, model.near)
        if INTERVAL2 in model.gaussians.tables:
            measure_intervals(model.gaussians, views, views.focal, model.near, 1.0, model.gaussians[INTERVAL2])

    def survey(self) -> Survey:
        """Return the training views for the rules of an edit."""
        return Survey(self.rasterizer, self.model, self.photographs, self.scene.split("train"), self.seed, self.step)

    def texture_quantile(self, share: float) -> float:
        """Return the gradient magnitude, per px, that `share` of the training photographs' pixels stay below."""
        if share not in self._texture_quantiles:
            photographs = (self.photographs.get(view) for view in self.scene.split("train"))
            self._texture_quantiles[share] = texture_quantile(self.rasterizer.workspace, photographs, share)
        return self._texture_quantiles[share]

    def training_images(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the photographs of the training views, each [height, width, 3]."""
        views = self.scene.split("train")
        for view in self.status.counted(views, "photographs", len(views)):
            yield self.photographs.get(view).image()


# The model of a run as it goes into files: its tables on the host, and how it was rendered in training.


def host_model(run: Run) -> Model:
    """Copy the model to the host, as it is trained: with a world filter that is not part of its scales.

    Raises ConfigError when no stage has made one.
    """
    model, gaussians = run.model, run.model.gaussians
    tables = {name: gaussians.get(name) for name in (*gaussians.trained, "filter_variance")}
    if not tables["filter_variance"].any():
        del tables["filter_variance"]
    rendering = Rendering.of({"version": __version__, **_rendering(run)}, "default")
    return Model(**tables, rendering=rendering, sky=model.sky.host() if model.sky else None)


def _rendering(run: Run) -> dict[str, Any]:
    """The numbers for rendering a model file as in training."""
    model = run.model
    found: dict[str, Any] = {
        "near": model.near,
        "screen_variance": model.screen_variance,
        "compensate": model.compensate,
        "background": run.photographs.background_name,
        "alpha": run.original.views[0].alpha,
    }
    if model.pixel_box:
        found["pixel_box"] = model.pixel_box
    if model.sky:
        found["sky"] = "directions"
    return found
