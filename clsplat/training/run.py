"""Everything that changes while a pipeline runs."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError
from clsplat.gaussians.model import Model
from clsplat.opencl.device import Device
from clsplat.render.renderer import Renderer
from clsplat.scene.scene import Scene, View
from clsplat.training.adam import Adam
from clsplat.training.filters import FilterViews, ModelSettings
from clsplat.training.records import Records
from clsplat.training.sampling import Sampling, ViewOrder
from clsplat.training.statistics import SplatStats
from clsplat.training.targets import Targets

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
    renderer: Renderer
    targets: Targets
    model_settings: ModelSettings
    sampling: Sampling = "uniform"
    model: Model | None = None
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

    @property
    def trained(self) -> Model:
        """The model.  Raises ConfigError when no stage has made one."""
        if self.model is None:
            raise ConfigError("no model yet: an init stage must come first")
        return self.model

    @property
    def scale(self) -> float:
        """The finest scale that is trained on: by what the photographs' size is divided."""
        return self.scene.scales[0]

    def train_view(self) -> View:
        """The view of the current step."""
        return self._order.at(self.step)

    def refresh_filter(self) -> None:
        """Let the world filter follow the Gaussians: after they are made, and after their number changes."""
        if self._filter_views is None:
            self._filter_views = FilterViews(self.device, self.scene.split("train"))
        model = self.trained
        self.model_settings.world_filter.refresh(model.gaussians, self._filter_views, model.near)

    def rendering(self) -> dict[str, Any]:
        """The numbers that a model file needs to be rendered as it was trained."""
        model = self.trained
        return {
            "near": model.near,
            "screen_variance": model.screen_variance,
            "compensate": model.compensate,
            "background": self.targets.background_name,
        }
