"""Everything that changes while a pipeline runs."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat.density.statistics import SplatStats
from clsplat.errors import ConfigError
from clsplat.filters import FilterViews, ModelSettings, measure_intervals
from clsplat.gaussians.tables import INTERVAL2, DeviceModel
from clsplat.opencl.device import Device
from clsplat.render.rasterizer import PIXEL_SUMS, Rasterizer
from clsplat.scene.scene import Scene, View
from clsplat.training.adam import Adam
from clsplat.training.memory import MemoryPlan, plan
from clsplat.training.records import Records
from clsplat.views.order import Sampling, ViewOrder
from clsplat.views.photographs import Photographs
from clsplat.views.texture import texture_quantile

READ_AHEAD = 4  # photographs
LOG = logging.getLogger("clsplat")


@dataclass(frozen=True)
class Progress:
    """What the screen shows while training."""

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
    scene: Scene  # as trained on: at one scale or several
    photographs: Scene  # as read
    out: Path
    name: str
    seed: int
    pipeline: dict[str, Any]  # resolved settings, as written to pipeline.yaml
    rasterizer: Rasterizer
    targets: Photographs
    model_settings: ModelSettings
    sampling: Sampling = "uniform"
    prepared: dict[str, str] | None = None  # what `prepare:` made the photographs of, and where they lie
    model: DeviceModel | None = None
    adam: Adam | None = None
    stats: SplatStats | None = None
    step: int = 0  # updates done, or in progress
    cursor: int = 0  # stage in progress
    stage_step: int = 0  # steps done in it
    train_seconds: float = 0.0
    metrics: dict[str, dict[str, Any]] = field(default_factory=dict)  # split -> scale -> averages
    interrupted: bool = False  # finish the step, save, stop
    show: Callable[[Progress], None] = lambda progress: None

    def __post_init__(self) -> None:
        self.records = Records(self.out)
        self._order = ViewOrder(self.scene.split("train"), self.sampling, self.seed)
        self._filter_views: FilterViews | None = None
        self._texture_quantiles: dict[float, float] = {}

    @property
    def trained(self) -> DeviceModel:
        """The model.  Raises ConfigError when no stage has made one."""
        if self.model is None:
            raise ConfigError("no model yet: an init stage must come first")
        return self.model

    @property
    def scale(self) -> float:
        """The finest scale that is trained on: by what the photographs' size is divided."""
        return self.scene.downscales[0]

    def train_view(self) -> View:
        """The view of the current step."""
        return self._order.at(self.step)

    def memory_plan(self) -> MemoryPlan:
        """What training with the present tables takes of the device's memory."""
        views = self.scene.split("train")
        bytes_held = min(self.targets.budget, sum(3 * view.camera.width * view.camera.height for view in views))
        tile = int(self.device.tuning["TILE"])
        pixels = max((-(-v.camera.width // tile)) * (-(-v.camera.height // tile)) * tile**2 for v in views)
        pixel_sums = PIXEL_SUMS if self.stats is None else self.stats.pixel_sums
        return plan(self.trained.gaussians, bytes_held, pixels, pixel_sums)

    def announce_views(self) -> None:
        """Let the photographs of the next steps be read ahead."""
        self.targets.announce(self._order.at(self.step + ahead) for ahead in range(1, READ_AHEAD + 1))

    def refresh_filter(self) -> None:
        """Let the world filter follow the Gaussians: after they are made, and after their number changes."""
        if self._filter_views is None:
            self._filter_views = FilterViews(self.device, self.scene.split("train"))
        model, views = self.trained, self._filter_views
        self.model_settings.world_filter.refresh(model.gaussians, views, model.near)
        if INTERVAL2 in model.gaussians.tables:
            measure_intervals(model.gaussians, views, views.focal, model.near, 1.0, model.gaussians[INTERVAL2])

    def texture_quantile(self, share: float) -> float:
        """The gradient magnitude, per px, that `share` of the training photographs' pixels stay below."""
        if share not in self._texture_quantiles:
            targets = (self.targets.get(view) for view in self.scene.split("train"))
            self._texture_quantiles[share] = texture_quantile(self.rasterizer.workspace, targets, share)
        return self._texture_quantiles[share]

    def rendering(self) -> dict[str, Any]:
        """The numbers that a model file needs to be rendered as it was trained."""
        model = self.trained
        return {
            "near": model.near,
            "screen_variance": model.screen_variance,
            "compensate": model.compensate,
            "background": self.targets.background_name,
            "alpha": self.photographs.views[0].alpha,
        }
