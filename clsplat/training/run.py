"""Define the state of a pipeline while it runs."""

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
from clsplat.photos.photographs import Photographs, compute_texture_quantile
from clsplat.render.filters import FilterViews, ModelSettings, measure_intervals
from clsplat.render.painter import Painter, SplatPainter
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.scene.identity import Identity
from clsplat.scene.scene import Scene, scene_name
from clsplat.training.adam import Adam
from clsplat.training.best_model import Best, Tables
from clsplat.training.field import TrainedField
from clsplat.training.memory import VISIBLE_FRACTION, Harmonics, Location, MemoryPlan, max_pixels, module_bytes, plan
from clsplat.training.records import Records, read_clocks
from clsplat.training.status import StatusFile

Item = TypeVar("Item")


@dataclass
class Run:
    """The mutable state of a pipeline run; stages read and change it."""

    device: Device
    scene: Scene  # the scene for training, at one or several sizes
    original: Scene  # the scene as read from the dataset, at full size
    out: Path
    name: str
    seed: int
    settings: Settings  # the pipeline
    pipeline: dict[str, Any]  # the resolved keys of `settings`, as written to pipeline.yaml
    rasterizer: Rasterizer
    photographs: Photographs
    status: StatusFile
    model_settings: ModelSettings
    harmonics: Harmonics = "device"  # memory for the bands above 0 in training
    identity: Identity | None = None  # hashes of the original scene and its photographs
    file_hashes: dict[str, str] = field(default_factory=dict)  # hashes of the files that settings name, by path
    prepared: dict[str, str] | None = None  # hash of the inputs of `prepare:`, and the folder of its result
    preparation: dict[str, dict[str, Any]] = field(default_factory=dict)  # results of the steps of `prepare:`
    losses: list[Loss] = field(default_factory=list)  # losses from Python, in addition to the pipeline's
    adam: Adam | None = None
    stats: SplatStats | None = None
    modules: dict[str, Any] = field(default_factory=dict)  # states of training modules, by type
    learned_field: TrainedField | None = None  # field that is trained instead of Gaussians
    step: int = 0  # global step that is done or in progress
    stage_index: int = 0  # current stage
    stage_step: int = 0  # number of steps done in that stage
    during_index: int = 0  # number of stages in `during` done after that step
    edited: bool = False  # whether the edits due at that step are done
    is_consistent: bool = True  # False after a failure in the middle of an edit of the tables
    changes: list[str] = field(default_factory=list)  # settings that changed when the run resumed
    image_downscale: float = 1.0  # downscale of the photograph in the step before an edit
    resumed_inputs: str = ""  # `inputs` of the checkpoint that the run resumed from
    scalars: dict[str, float] = field(default_factory=dict)  # state of rules and budgets, by name
    best: Best | None = None  # the best model by validation
    best_tables: Tables = field(default_factory=dict)  # tables of the best model, on the host, during training
    cache: dict[Any, Any] = field(default_factory=dict)  # measurements of modules, by keys that they choose
    train_seconds: float = 0.0
    cpu_seconds: float = 0.0  # CPU time of all threads of the process during `train_seconds`
    model_hashes: dict[str, str] = field(default_factory=dict)  # SHA-256 of model files, by path in the run folder
    metrics: dict[str, dict[str, Any]] = field(default_factory=dict)  # split -> downscale -> averages
    interrupted: bool = False  # whether to finish the step, save, and stop
    on_progress: Callable[[Progress], None] = lambda progress: None
    # called between steps, or items of a long stage; must not change the run
    on_step: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.records = Records(self.out, self.status.require_lock)
        self._model: DeviceModel | None = None
        self._filter_views: FilterViews | None = None
        self._texture_quantiles: dict[float, float] = {}

    @property
    def model(self) -> DeviceModel:
        """The Gaussians and their rendering settings.  Raises ConfigError if no stage has created a model."""
        if self._model is None:
            raise ConfigError("no model yet: an init stage must come first")
        for state in self.modules.values():
            state.attach_to(self._model)
        return self._model

    @model.setter
    def model(self, model: DeviceModel) -> None:
        self._model, self.learned_field = model, None

    def painter(self, rasterizer: Rasterizer | None = None) -> Painter:
        """Return the renderer of views.  rasterizer: by default, that of training.  Raises ConfigError like `model`."""
        if self.learned_field:
            return self.learned_field.painter
        return SplatPainter(rasterizer or self.rasterizer, self.model, self.photographs.background)

    @property
    def gaussians(self) -> int | None:
        """The number of Gaussians; None if a field is trained."""
        return None if self.learned_field else self.model.gaussians.count

    def find_nonfinite(self) -> list[str]:
        """Return the names of the trained tables that contain NaN or infinity."""
        return self.learned_field.find_nonfinite() if self.learned_field else self.model.gaussians.find_nonfinite()

    def next_stage(self, index: int) -> None:
        """Move to the start of a stage."""
        self.stage_index, self.stage_step, self.during_index, self.edited = index, 0, 0, False
        self.records.line_count_at_stage = self.records.line_count
        self.modules = {name: state for name, state in self.modules.items() if state.after_training != "dropped"}
        if self._model is not None:
            self.model.gaussians.tables.pop(HIDDEN, None)  # valid only within one training

    @property
    def model_step(self) -> int:
        """The global step of the model's last update; less than `step` if the run returned to its best model."""
        is_best = self.best is not None and self.best.ended == self.step and self.best.refit != "begun"
        return self.best.measured.step if self.best and is_best else self.step

    @property
    def is_refit(self) -> bool:
        """Whether the run is training again with the validation views too, up to the step of the best model."""
        return self.best is not None and self.best.refit == "begun"

    def restart_for_refit(self, best: Best) -> None:
        """Reset the run to the start of its pipeline, to train again for the number of steps of the best model."""
        self._model = None
        self.adam = self.stats = None
        self.modules = {}
        self.scalars = {}
        self.metrics = {}
        self.model_hashes = {}
        self.is_consistent = True
        self.step = 0
        self.image_downscale = 1.0
        self.best = best
        self.best_tables = {}
        self.next_stage(0)
        self.use_split(self.original.merge_validation())

    def use_split(self, original: Scene) -> None:
        """Replace the original scene with one that has a different split of its views."""
        self.original, self.scene = original, original.downscaled(*self.scene.downscales)
        self._filter_views, self._texture_quantiles = None, {}

    @contextmanager
    def editing_tables(self) -> Iterator[None]:
        """Mark the run as inconsistent while the block edits its tables; it stays inconsistent if the block fails."""
        was_consistent, self.is_consistent = self.is_consistent, False
        yield
        self.is_consistent = was_consistent

    def add_training_time(self, start: tuple[float, float]) -> float:
        """Add the time since `start`, from `read_clocks`, to the training time.  Return the wall-clock seconds."""
        seconds, cpu = (end - begin for end, begin in zip(read_clocks(), start, strict=True))
        self.train_seconds += seconds
        self.cpu_seconds += cpu
        return seconds

    @property
    def scene_name(self) -> str:
        """The name of the scene in reports."""
        return scene_name(self.pipeline["scene"]["path"] or self.scene.path)

    @property
    def inputs(self) -> str:
        """The hash of the photographs, cameras, and points; "" if they were not hashed."""
        return self.identity.digest if self.identity else ""

    @property
    def has_model(self) -> bool:
        """Whether there is a model or a field to save."""
        return self._model is not None or self.learned_field is not None

    def until_interrupted(self, items: Iterable[Item]) -> Iterator[Item]:
        """Yield the items of a long stage; raise Stopped between two of them if the run is interrupted."""
        for item in items:
            if self.interrupted:
                raise Stopped("stopped")
            self.on_step()
            yield item

    @property
    def downscale(self) -> float:
        """The smallest factor by which photographs are downscaled in training."""
        return self.scene.downscales[0]

    def memory_plan(
        self,
        components: Mapping[str, int] | None = None,
        harmonics: Location | None = None,
        visible: float = VISIBLE_FRACTION,
    ) -> MemoryPlan:
        """Plan the device memory for training with the current tables, or with tables of these `components`.

        harmonics: where the bands above 0 are stored; None for their current location.  visible: as in `plan`.
        """
        if harmonics is None:
            harmonics = "host" if self.model.gaussians.on_host else "device"
        components = components or self.model.gaussians.components
        views, tile = self.scene.split("train"), int(self.device.tuning["TILE"])
        image_bytes = min(self.photographs.budget, sum(4 * view.camera.width * view.camera.height for view in views))
        image_bytes += module_bytes(getattr(self.settings, "stages", ()), views, tile)
        pixels = max_pixels(views, tile)
        pixel_sums = PIXEL_SUMS if self.stats is None else self.stats.pixel_sums
        return plan(self.device.info, components, image_bytes, pixels, pixel_sums, harmonics, visible, tile)

    def refresh_filter(self) -> None:
        """Recompute the world filter and the sampling intervals for the current Gaussians."""
        if self._filter_views is None:
            self._filter_views = FilterViews(self.device, self.scene.split("train"))
        model, views = self.model, self._filter_views
        self.model_settings.world_filter.refresh(model.gaussians, views, model.near)
        if INTERVAL2 in model.gaussians.tables:
            measure_intervals(model.gaussians, views, views.focal, model.near, 1.0, model.gaussians[INTERVAL2])

    def survey(self) -> Survey:
        """Return a survey of the training views for the rules of an edit."""
        return Survey(self.rasterizer, self.model, self.photographs, self.scene.split("train"), self.seed, self.step)

    def compute_texture_quantile(self, q: float) -> float:
        """Return the quantile `q` of the gradient magnitude, px⁻¹, over the pixels of all training photographs."""
        if q not in self._texture_quantiles:
            photographs = (self.photographs.get(view) for view in self.scene.split("train"))
            self._texture_quantiles[q] = compute_texture_quantile(self.rasterizer.workspace, photographs, q)
        return self._texture_quantiles[q]

    def training_images(self) -> Iterator[NDArray[np.uint8]]:
        """Yield the photographs of the training views, each [height, width, 3], and report the progress."""
        views = self.scene.split("train")
        for view in self.status.counted(views, "photos", len(views)):
            yield self.photographs.get(view).image()


# A run's model for files: its tables on the host, and the rendering settings of training.


def host_model(run: Run) -> Model:
    """Copy the model to the host, with its world filter as a separate table, not baked into the scales.

    Raises ConfigError if no stage has created a model.
    """
    model, gaussians = run.model, run.model.gaussians
    tables = {name: gaussians.get(name) for name in (*gaussians.trained, "filter_variance")}
    if not tables["filter_variance"].any():
        del tables["filter_variance"]
    rendering = Rendering.from_comment({"version": __version__, **_rendering(run)}, "default")
    return Model(**tables, rendering=rendering, sky=model.sky.to_host() if model.sky else None, origin=run.scene.origin)


def sky_center(run: Run) -> NDArray[np.float64]:
    """Return the median camera position, [3], for a sky that is exported as Gaussians, which looks exact from there."""
    return np.median([view.position for view in run.scene.views], axis=0)


def _rendering(run: Run) -> dict[str, Any]:
    """Return the rendering settings that viewers need to render the model as in training."""
    model = run.model
    rendering: dict[str, Any] = {
        "near": model.near,
        "screen_variance": model.screen_variance,
        "compensate": model.compensate,
        "background": run.photographs.background_name,
        "alpha": run.original.views[0].alpha,
    }
    if model.pixel_box:
        rendering["pixel_box"] = model.pixel_box
    if model.sky:
        rendering["sky"] = "directions"
    return rendering
