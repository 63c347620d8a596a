"""What a pipeline file can say.

    name, seed, scene: {path, downscale, background, …}, model: {…}, rasterizer: {schedule, sort, …}
    stages: a list of   - <stage>   or   - <stage>: {field: value, …}

A file is complete and strict: unknown keys are errors, and every value has its default in its model.
"""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from clsplat.errors import ConfigError
from clsplat.filters import ModelSettings
from clsplat.opencl.choice import Schedule
from clsplat.prepare.steps import Step
from clsplat.render.rasterizer import MAX_PAIRS, RECORD, Budget
from clsplat.render.tiles import Sort
from clsplat.scene.detect import read_scene
from clsplat.scene.scene import HOLDOUT, Alpha, Background, Scene
from clsplat.settings import OneOf, Settings
from clsplat.stages.base import Stage
from clsplat.stages.optimize import Optimize


class SceneSettings(Settings):
    """Which photographs, and how they are read."""

    path: str | None = None
    """Folder of the dataset; usually given by --scene."""
    downscale: Annotated[float, Field(ge=1)] = 1
    """Divisor of the photographs' size."""
    levels: Annotated[int, Field(ge=1, le=8)] = 1
    """Number of sizes to train on: downscale, and twice, four times, … that."""
    alpha: Alpha = "transparency"
    """Fourth channel of photographs: blended with the background, or a mask of what counts."""
    background: Literal["auto", "black", "white"] = "auto"
    """Colour behind the scene; auto: white for Blender scenes, else black."""
    image_budget: Annotated[int, Field(gt=0)] | None = None
    """MiB of photographs on the device; without it, a quarter of its memory."""
    holdout: Annotated[int, Field(ge=0)] = HOLDOUT
    """Every n-th image, by name, is a test view; 0: none."""

    @property
    def scales(self) -> tuple[float, ...]:
        """Divisors of the original photographs' size to train on, from the finest."""
        return tuple(self.downscale * 2**level for level in range(self.levels))

    @property
    def folder(self) -> Path:
        """Where the photographs lie.  Raises ConfigError when it was not given."""
        if self.path is None:
            raise ConfigError("no scene given; use --scene DIR, or scene: {path: DIR} in the pipeline file")
        return Path(self.path)

    def read(self, folder: Path) -> tuple[Scene, Background]:
        """Return the photographs of a folder, and what they are shown on.  Raises DataError."""
        return self.applied(read_scene(folder, self.holdout))

    def applied(self, scene: Scene) -> tuple[Scene, Background]:
        """Return a scene with its photographs' alpha as these settings take it, and what they are shown on."""
        return scene.with_alpha(self.alpha), scene.background if self.background == "auto" else self.background


class RasterizerSettings(Settings):
    """How the device works; results do not depend on it."""

    schedule: Schedule = "auto"
    """Schedule of blending: wide for CPUs, simt for GPUs."""
    sort: Sort = "auto"
    """Way to order splats by tile and depth; auto: the faster one on the first frame."""
    pair_budget: Annotated[int, Field(gt=0)] | None = None
    """MiB of gradient records; without it, the largest buffer of the device."""
    launch_tiles: Annotated[int, Field(ge=0)] = 0
    """Tiles blended by one launch, for watchdogs of displays; 0: all."""

    def budget(self) -> Budget | None:
        """How much the rasterizer does at a time."""
        if self.pair_budget is None and self.launch_tiles == 0:
            return None
        records = MAX_PAIRS if self.pair_budget is None else (self.pair_budget << 20) // (4 * RECORD)
        return Budget(records, self.launch_tiles)


LISTS = ("prepare", "stages")
Name = Annotated[str, Field(pattern=r"^[\w.-]+$")]


class PipelineFile(Settings):
    """All that a pipeline file can say."""

    name: Name
    """Name of the pipeline, and of its run folder."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of all random numbers."""
    scene: SceneSettings = SceneSettings()
    """Which photographs."""
    model: ModelSettings = ModelSettings()
    """How Gaussians are rendered."""
    rasterizer: RasterizerSettings = RasterizerSettings()
    """How the device works."""
    prepare: list[OneOf[Step]] = Field([])
    """Steps from photographs to a scene, each done once."""
    stages: Annotated[list[OneOf[Stage]], Field(min_length=1)]
    """What is done with the scene, in order."""
    plugins: dict[str, str] = Field(default={})
    """Plug-ins that the run was made with: name and sha256; written by a run, and then required."""

    @property
    def training(self) -> Optimize:
        """The first stage that trains.  Raises ConfigError when none does."""
        for stage in self.stages:
            if isinstance(stage, Optimize):
                return stage
        raise ConfigError(f"{self.name}: expected a stage 'optimize', whose steps can be timed")
