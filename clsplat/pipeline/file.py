"""What a pipeline file can say.

    name, seed, scene: {path, downscale, background, …}, model: {…}, rasterizer: {schedule, sort, …}
    stages: a list of   - <stage>   or   - <stage>: {field: value, …}

A file is complete and strict: unknown keys are errors, and every value has its default in its model.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, field_validator

from clsplat.core.errors import ConfigError
from clsplat.core.files import invalid_name_reason
from clsplat.core.settings import InputPath, OneOf, Settings, iter_settings
from clsplat.opencl.discovery import Schedule
from clsplat.pipeline.adapt import Adaptation
from clsplat.prepare.steps import Step
from clsplat.render.filters import ModelSettings
from clsplat.render.rasterizer import MAX_PAIRS, RECORD, RenderLimits
from clsplat.render.tiles import Sort
from clsplat.scene.detect import read_scene
from clsplat.scene.images import Missing
from clsplat.scene.photographs import with_masks
from clsplat.scene.scene import HOLDOUT, Background, Scene
from clsplat.scene.view import Alpha
from clsplat.scene.view_selection import Choice, Chosen, ChosenOrAuto, Split
from clsplat.stages.optimize import Optimize
from clsplat.training.memory import Harmonics
from clsplat.training.stage import ON_HOST, Stage, Training


class SceneSettings(Settings):
    """The photographs, and how they are read."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"image_budget"})

    path: InputPath | None = None
    """Folder of the dataset; usually given by --scene."""
    downscale: Annotated[float, Field(ge=1)] = 1
    """Divisor of the photographs' size."""
    levels: Annotated[int, Field(ge=1, le=8)] = 1
    """Number of sizes in training: at `downscale`, and at twice, four times, … that."""
    alpha: Alpha = "transparency"
    """Fourth channel of photographs: blended with the background, or a mask of the pixels that count."""
    masks: InputPath | None = None
    """Folder of masks that something else has made, for a dataset without: `a.png` or `a.jpg.png` of the photograph
    a.jpg, of its size, white in pixels that count.  A photograph without one counts whole."""
    background: Literal["auto", "black", "white"] = "auto"
    """Color behind the scene; auto: white for Blender scenes, else black."""
    image_budget: Annotated[int, Field(gt=0)] | None = None
    """MiB of photographs on the device; without it, a quarter of its memory."""
    holdout: Chosen = HOLDOUT
    """Test views: every n-th image by name, from the first on; 0: none; or {every, offset}, {names} or {file}.  Names
    replace the split of a dataset that has one."""
    train: Choice | None = None
    """Training views that are used, such as {every: 4}, and no others; without it, all."""
    validation: ChosenOrAuto = 0
    """Training views that are kept out to choose by (`optimize.keep`), as in `holdout`; auto: every 8th, from the
    fifth on, and two at least."""
    extent: Annotated[float, Field(gt=0)] | None = None
    """Radius of the scene, scene units, of which sizes and rates are shares; without it, that of the training
    cameras.  A part of a scene is trained with that of the whole."""
    missing: Missing = "refuse"
    """Photographs that the dataset names and does not have: an error, or `skip`: the scene is read without them."""

    @field_validator("masks")
    @classmethod
    def _from_any_folder(cls, masks: str | None) -> str | None:
        """A run is measured from other working folders than that where it began."""
        return masks and str(Path(masks).absolute())

    @property
    def downscales(self) -> tuple[float, ...]:
        """Divisors of the original photographs' size in training, ascending."""
        return tuple(self.downscale * 2**level for level in range(self.levels))

    @property
    def folder(self) -> Path:
        """Folder of the dataset.  Raises ConfigError when it was not given."""
        if self.path is None:
            raise ConfigError("no scene given; use --scene DIR, or scene: {path: DIR} in the pipeline file")
        return Path(self.path)

    @property
    def split(self) -> Split:
        """What of the dataset is for training, validation and testing."""
        lists = None if self.path is None else Path(self.path)
        return Split(self.holdout, self.train, self.validation, self.missing, lists)

    def masked(self, scene: Scene) -> Scene:
        """Return a scene with its masks as set.  Raises DataError where the folder has none of them."""
        return with_masks(scene, None if self.masks is None else Path(self.masks))

    def read(self, folder: Path) -> tuple[Scene, Background]:
        """Return the scene of a folder with these settings, and its background.  Raises DataError."""
        return self.applied(read_scene(folder, self.split))

    def applied(self, scene: Scene) -> tuple[Scene, Background]:
        """Return a scene with these settings for alpha, masks and extent, and its background.  Raises DataError."""
        found = replace(self.masked(scene).with_alpha(self.alpha), extent=self.extent or scene.extent)
        return found, scene.background if self.background == "auto" else self.background


class RasterizerSettings(Settings):
    """How the device renders; results do not depend on it, but for where its memory ends growth."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"harmonics"})

    schedule: Schedule = "auto"
    """Schedule of blending: wide for CPUs, simt for GPUs."""
    sort: Sort = "auto"
    """Algorithm that orders splats by tile and depth; auto: the faster one on the first frame."""
    pair_budget: Annotated[int, Field(gt=0)] | None = None
    """MiB of gradient records at a time; without it, the largest buffer of the device."""
    harmonics: Harmonics = "auto"
    """Memory of the harmonics above band 0 and of Adam's moments of them, in training.  `host`: each step sends those
    of its view to the device and fetches them; what other views see is updated later (`optimize.update: deferred`).
    `auto`: the device, until it does not hold as many Gaussians as there are to be, and the host from then on."""
    launch_tiles: Annotated[int, Field(ge=0)] = 0
    """Number of tiles of one launch, for devices whose display limits its time; 0: all."""

    def conflict_names(self) -> set[str]:
        return {ON_HOST} if self.harmonics == "host" else set()

    def budget(self) -> RenderLimits | None:
        """Return the rasterizer's limits on memory and launches; None for the defaults."""
        if self.pair_budget is None and self.launch_tiles == 0:
            return None
        records = MAX_PAIRS if self.pair_budget is None else (self.pair_budget << 20) // (4 * RECORD)
        return RenderLimits(records, self.launch_tiles)


STAGE_LISTS = ("prepare", "stages")


def _folder_name(name: str) -> str:
    if fault := invalid_name_reason(name):
        raise ValueError(f"expected the name of a folder: {fault}")
    return name


Name = Annotated[str, Field(pattern=r"^[\w.-]*\w[\w.-]*$"), AfterValidator(_folder_name)]  # not only dots


class PipelineFile(Settings):
    """The keys of a pipeline file."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"adapt"})  # what they set is compared at its place

    name: Name
    """Name of the pipeline, and of its run folder."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of all random numbers."""
    scene: SceneSettings = SceneSettings()
    """The photographs."""
    model: ModelSettings = ModelSettings()
    """How Gaussians are rendered."""
    rasterizer: RasterizerSettings = RasterizerSettings()
    """How the device renders."""
    prepare: list[OneOf[Step]] = Field([])
    """Steps from photographs to a scene; their results are kept."""
    adapt: OneOf[Adaptation] | None = None
    """What decides settings by the photographs, before the first step."""
    stages: Annotated[list[OneOf[Stage]], Field(min_length=1)]
    """Stages, in order."""
    plugins: dict[str, str] = Field(default={})
    """Plug-ins of the run: name and sha256.  A run writes them, and a resumed run requires them."""

    def check_together(self) -> None:
        """Raise ConfigError for the first settings that do not go together, as their classes say."""
        found = list(iter_settings(self))
        for place, one in found:
            one.check_pipeline(self)
            for name, why in one.excluded().items():
                for other, rival in found:
                    apart = other.startswith("stages[") and other.partition(".")[0] != place.partition(".")[0]
                    if name in rival.conflict_names() and not apart:
                        own = getattr(one, "type", getattr(one, "stage", place))
                        remedy = "" if ";" in why else "; leave one of them out"
                        raise ConfigError(f"{place}: '{own}' does not go together with {name} ({other}): {why}{remedy}")

    @property
    def harmonics(self) -> Harmonics:
        """Where harmonics lie: `auto` is the device where a stage needs all of them there, or bands above 0 lack."""
        asked = self.rasterizer.harmonics
        is_needed = any(ON_HOST in one.excluded() for _, one in iter_settings(self.stages))
        return "device" if asked == "auto" and (self.model.sh_degree == 0 or is_needed) else asked

    @property
    def training(self) -> Training:
        """The first stage that trains.  Raises ConfigError when none does."""
        for stage in self.stages:
            if isinstance(stage, Training):
                return stage
        raise ConfigError(f"{self.name}: expected a stage that trains, such as 'optimize'")

    @property
    def optimize(self) -> Optimize:
        """The first stage that trains Gaussians.  Raises ConfigError when none does."""
        for stage in self.stages:
            if isinstance(stage, Optimize):
                return stage
        raise ConfigError(f"{self.name}: expected a stage 'optimize'")
