"""Define the keys of a pipeline file.

    name, seed, scene: {path, downscale, background, …}, model: {…}, rasterizer: {schedule, sort, …}
    stages: a list of   - <stage>   or   - <stage>: {field: value, …}

Unknown keys are errors.  The pydantic models in the code define the defaults.
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
from clsplat.scene.lookup import Missing
from clsplat.scene.photographs import with_masks
from clsplat.scene.scene import HOLDOUT, Background, Scene
from clsplat.scene.view import Alpha
from clsplat.scene.view_selection import Selection, SelectionOrAuto, Split, ViewSelection
from clsplat.stages.optimize import Optimize
from clsplat.training.memory import Harmonics
from clsplat.training.stage import ON_HOST, Stage, Training


class SceneSettings(Settings):
    """The dataset and how its photos are read."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"image_budget"})

    path: InputPath | None = None
    """Folder of the dataset; usually given by --scene."""
    downscale: Annotated[float, Field(ge=1)] = 1
    """Divisor of the image size."""
    levels: Annotated[int, Field(ge=1, le=8)] = 1
    """Number of image sizes in training, with divisors of `downscale`, twice `downscale`, four times `downscale`, …."""
    alpha: Alpha = "transparency"
    """Use of the alpha channel of images: `transparency` blends images with the background, `mask` masks pixels out."""
    masks: InputPath | None = None
    """Folder of masks, if the dataset has none: `a.png` or `a.jpg.png` for the image a.jpg, of the same size, white
    where pixels are used.  Without a mask, all pixels of an image are used."""
    background: Literal["auto", "black", "white"] = "auto"
    """Color behind the scene; auto: white for Blender scenes, else black."""
    image_budget: Annotated[int, Field(gt=0)] | None = None
    """Memory for images on the device, MiB; default: a quarter of the device's memory."""
    holdout: Selection = HOLDOUT
    """Test views: every n-th image by name, starting with the first; 0: none; or {every, offset}, {names} or {file}.
    Names replace the split of a dataset that has one."""
    train: ViewSelection | None = None
    """Training views to use, such as {every: 4}; default: all."""
    validation: SelectionOrAuto = 0
    """Training views held out to choose the best model (`optimize.keep`), as for `holdout`; auto: every 8th, starting
    with the fifth, and at least two."""
    extent: Annotated[float, Field(gt=0)] | None = None
    """Radius of the scene in scene units, to which sizes and rates are relative; default: that of the training cameras.
    To train part of a scene, set the extent of the whole scene."""
    missing: Missing = "refuse"
    """What to do if images that the dataset names do not exist: refuse the scene, or skip these images."""

    @field_validator("masks")
    @classmethod
    def _make_absolute(cls, masks: str | None) -> str | None:
        """Make the path absolute, as a run may be evaluated from another working directory."""
        return masks and str(Path(masks).absolute())

    @property
    def downscales(self) -> tuple[float, ...]:
        """The divisors of the original image size in training, in ascending order."""
        return tuple(self.downscale * 2**level for level in range(self.levels))

    @property
    def folder(self) -> Path:
        """The folder of the dataset.  Raises ConfigError if no scene is set."""
        if self.path is None:
            raise ConfigError("no scene given; use --scene DIR, or scene: {path: DIR} in the pipeline file")
        return Path(self.path)

    @property
    def split(self) -> Split:
        """The rules that assign views to training, validation, and testing."""
        lists = None if self.path is None else Path(self.path)
        return Split(self.holdout, self.train, self.validation, self.missing, lists)

    def apply_masks(self, scene: Scene) -> Scene:
        """Return the scene with masks from the folder `masks`.  Raises DataError if the folder has none for it."""
        return with_masks(scene, None if self.masks is None else Path(self.masks))

    def read(self, folder: Path) -> tuple[Scene, Background]:
        """Read the scene with these settings, and return it with its background color.  Raises DataError."""
        return self.apply(read_scene(folder, self.split))

    def apply(self, scene: Scene) -> tuple[Scene, Background]:
        """Return a scene with alpha, masks, and extent applied, and its background color.  Raises DataError."""
        new_scene = replace(self.apply_masks(scene).with_alpha(self.alpha), extent=self.extent or scene.extent)
        return new_scene, scene.background if self.background == "auto" else self.background


class RasterizerSettings(Settings):
    """How the device renders.  Results do not depend on these keys, unless growth stops because memory is full."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"harmonics"})

    schedule: Schedule = "auto"
    """Blending schedule: `wide` for CPUs; for GPUs, `simt` with tiles of 8×8 px, or `simt16` with tiles of 16×16 px.
    A resumed run on the same device keeps what `auto` chose."""
    sort: Sort = "auto"
    """Algorithm that sorts splats by tile and depth; auto: bitonic on GPUs unless lists are very long, else radix."""
    pair_budget: Annotated[int, Field(gt=0)] | None = None
    """Memory for gradient records, MiB; default: the largest buffer of the device."""
    harmonics: Harmonics = "auto"
    """Memory for the spherical harmonics above band 0 and their Adam moments in training.  `host`: each step uploads
    the Gaussians that its view sees, and downloads them again; the others are updated later, as with
    `optimize.update: deferred`.
    `auto`: the device, or the host once the device cannot hold the expected number of Gaussians."""
    launch_tiles: Annotated[int, Field(ge=0)] = 0
    """Number of tiles per launch, for devices whose display driver limits the time of a launch; 0: all."""

    def conflict_names(self) -> set[str]:
        return {ON_HOST} if self.harmonics == "host" else set()

    def limits(self) -> RenderLimits | None:
        """Return the rasterizer's limits on memory and launches, or None for the defaults."""
        if self.pair_budget is None and self.launch_tiles == 0:
            return None
        records = MAX_PAIRS if self.pair_budget is None else (self.pair_budget << 20) // (4 * RECORD)
        return RenderLimits(records, self.launch_tiles)


STAGE_LISTS = ("prepare", "stages")


def _check_folder_name(name: str) -> str:
    if fault := invalid_name_reason(name):
        raise ValueError(f"expected the name of a folder: {fault}")
    return name


Name = Annotated[str, Field(pattern=r"^[\w.-]*\w[\w.-]*$"), AfterValidator(_check_folder_name)]  # not only dots


class PipelineFile(Settings):
    """The keys of a pipeline file."""

    output_keys: ClassVar[frozenset[str]] = frozenset({"adapt"})  # decisions are compared at the keys that they set

    name: Name
    """Name of the pipeline, and of its run folder."""
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    """Seed of all random numbers."""
    scene: SceneSettings = SceneSettings()
    """The photos."""
    model: ModelSettings = ModelSettings()
    """How Gaussians are rendered."""
    rasterizer: RasterizerSettings = RasterizerSettings()
    """How the device renders."""
    prepare: list[OneOf[Step]] = Field([])
    """Steps from photos to a scene; later runs reuse their results."""
    adapt: OneOf[Adaptation] | None = None
    """Decide settings based on the photos, before the first step."""
    stages: Annotated[list[OneOf[Stage]], Field(min_length=1)]
    """Stages, in order."""
    plugins: dict[str, str] = Field(default={})
    """Plug-ins of the run: name and sha256.  A run writes them, and a resumed run needs them."""

    def check_conflicts(self) -> None:
        """Raise ConfigError for the first two settings whose classes declare that they exclude each other."""
        items = list(iter_settings(self))
        for path, settings in items:
            settings.check_pipeline(self)
            for name, reason in settings.active_conflicts().items():
                for other_path, other_settings in items:
                    stage, other_stage = path.partition(".")[0], other_path.partition(".")[0]
                    is_elsewhere = other_stage.startswith("stages[") and other_stage != stage
                    if name in other_settings.conflict_names() and not is_elsewhere:
                        label = getattr(settings, "type", getattr(settings, "stage", path))
                        remedy = "" if ";" in reason else "; leave one of them out"
                        message = f"{path}: '{label}' cannot be combined with {name} ({other_path}): {reason}{remedy}"
                        raise ConfigError(message)

    @property
    def harmonics(self) -> Harmonics:
        """Where spherical harmonics are stored.

        `auto` becomes `device` at degree 0, or if a stage needs them on the device.
        """
        harmonics = self.rasterizer.harmonics
        needs_device = any(ON_HOST in settings.active_conflicts() for _, settings in iter_settings(self.stages))
        return "device" if harmonics == "auto" and (self.model.sh_degree == 0 or needs_device) else harmonics

    @property
    def training(self) -> Training:
        """The first stage that trains.  Raises ConfigError if there is none."""
        for stage in self.stages:
            if isinstance(stage, Training):
                return stage
        raise ConfigError(f"{self.name}: has no training stage; add one, such as 'optimize'")

    @property
    def optimize(self) -> Optimize:
        """The first stage that trains Gaussians.  Raises ConfigError if there is none."""
        for stage in self.stages:
            if isinstance(stage, Optimize):
                return stage
        raise ConfigError(f"{self.name}: has no 'optimize' stage; add one")
