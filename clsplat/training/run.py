"""The state of a pipeline while it runs."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat import __version__
from clsplat.density.statistics import SplatStats
from clsplat.errors import ConfigError
from clsplat.filters import FilterViews, ModelSettings, measure_intervals
from clsplat.gaussians.model import Model, Rendering
from clsplat.gaussians.tables import INTERVAL2, PARAMETERS, DeviceModel
from clsplat.losses.base import Loss
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.scene.scene import Scene
from clsplat.training.adam import Adam
from clsplat.training.memory import MemoryPlan, plan
from clsplat.training.records import Records
from clsplat.views.photographs import Photographs
from clsplat.views.texture import texture_quantile

LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class Progress:
    """The state of training, for the terminal."""

    step: int
    steps: int
    loss: float
    psnr: float  # dB, of the training view just rendered, before 8 bits
    gaussians: int
    milliseconds: float  # per step
    seconds_left: float


@dataclass
class Run:
    """The mutable state of a pipeline; stages read and change it."""

    device: Device
    scene: Scene  # as trained on: at one size or several
    original: Scene  # as read
    out: Path
    name: str
    seed: int
    pipeline: dict[str, Any]  # resolved settings, as written to pipeline.yaml
    rasterizer: Rasterizer
    photographs: Photographs
    model_settings: ModelSettings
    prepared: dict[str, str] | None = None  # hash of the inputs of `prepare:`, and the folder of its result
    losses: list[Loss] = field(default_factory=list)  # added from Python, beside those of the pipeline
    adam: Adam | None = None
    stats: SplatStats | None = None
    step: int = 0  # updates done, or in progress
    cursor: int = 0  # stage in progress
    stage_step: int = 0  # steps done in it
    train_seconds: float = 0.0
    metrics: dict[str, dict[str, Any]] = field(default_factory=dict)  # split -> downscale -> averages
    interrupted: bool = False  # finish the step, save, stop
    show: Callable[[Progress], None] = lambda progress: None

    def __post_init__(self) -> None:
        self.records = Records(self.out)
        self._model: DeviceModel | None = None
        self._filter_views: FilterViews | None = None
        self._texture_quantiles: dict[float, float] = {}

    @property
    def model(self) -> DeviceModel:
        """The model.  Raises ConfigError when no stage has made one."""
        if self._model is None:
            raise ConfigError("no model yet: an init stage must come first")
        return self._model

    @model.setter
    def model(self, model: DeviceModel) -> None:
        self._model = model

    @property
    def downscale(self) -> float:
        """The smallest divisor of the photographs' size in training."""
        return self.scene.downscales[0]

    def memory_plan(self) -> MemoryPlan:
        """Return the plan of the device's memory for training with the present tables."""
        views = self.scene.split("train")
        bytes_held = min(self.photographs.budget, sum(3 * view.camera.width * view.camera.height for view in views))
        tile = int(self.device.tuning["TILE"])
        pixels = max((-(-v.camera.width // tile)) * (-(-v.camera.height // tile)) * tile**2 for v in views)
        pixel_sums = PIXEL_SUMS if self.stats is None else self.stats.pixel_sums
        return plan(self.model.gaussians, bytes_held, pixels, pixel_sums)

    def refresh_filter(self) -> None:
        """Update the world filter and the sampling intervals to the present Gaussians."""
        if self._filter_views is None:
            self._filter_views = FilterViews(self.device, self.scene.split("train"))
        model, views = self.model, self._filter_views
        self.model_settings.world_filter.refresh(model.gaussians, views, model.near)
        if INTERVAL2 in model.gaussians.tables:
            measure_intervals(model.gaussians, views, views.focal, model.near, 1.0, model.gaussians[INTERVAL2])

    def texture_quantile(self, share: float) -> float:
        """Return the gradient magnitude, per px, that `share` of the training photographs' pixels stay below."""
        if share not in self._texture_quantiles:
            photographs = (self.photographs.get(view) for view in self.scene.split("train"))
            self._texture_quantiles[share] = texture_quantile(self.rasterizer.workspace, photographs, share)
        return self._texture_quantiles[share]

    def host_model(self) -> Model:
        """Copy the model to the host, as it is trained: with a world filter that is not part of its scales."""
        tables = {name: self.model.gaussians.get(name) for name in (*PARAMETERS, "filter_variance")}
        if not tables["filter_variance"].any():
            del tables["filter_variance"]
        return Model(**tables, rendering=Rendering.of({"version": __version__, **self.rendering()}, "default"))

    def rendering(self) -> dict[str, Any]:
        """Return the numbers for rendering a model file as in training."""
        model = self.model
        return {
            "near": model.near,
            "screen_variance": model.screen_variance,
            "compensate": model.compensate,
            "background": self.photographs.background_name,
            "alpha": self.original.views[0].alpha,
        }
