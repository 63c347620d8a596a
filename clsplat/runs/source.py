"""Which model and which photographs a command names: by a file, by the folder of a scene, or by that of a run."""

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from clsplat.compare.run_folder import read_metrics
from clsplat.errors import ConfigError, DataError, in_shell
from clsplat.formats.model_files import located
from clsplat.gaussians.model import Model
from clsplat.gaussians.run_model import MODEL, model_at, model_of_run
from clsplat.names import METRICS, PIPELINE
from clsplat.pipeline.file import SceneSettings
from clsplat.pipeline.loading import Pipeline, load
from clsplat.prepare.cache import noted
from clsplat.runs.found import has_pipeline
from clsplat.scene.detect import read_scene
from clsplat.scene.images import is_image
from clsplat.scene.scene import Alpha, Scene, scene_name
from clsplat.stages.export import Export
from clsplat.stages.export_field import ExportField
from clsplat.training.field_file import FieldModel, field_of_run, is_field


@dataclass(frozen=True)
class Source:
    """A model file, and the photographs whose cameras look at it."""

    file: Path
    folder: Path  # of the photographs
    settings: SceneSettings  # how they are read
    scene_name: str  # on pages
    alpha: Alpha | None = None  # None: as the model file says

    @classmethod
    def of(cls, model: Path, scene: Path | None) -> "Source":
        """Take a run folder, or a file that a run has exported, with its photographs; other files need `scene`.

        `scene`, a folder of photographs or of a run, replaces those of the model's run.  Raises DataError or
        ConfigError when one is not known.
        """
        run = run_of(model)
        trained = scene if scene is not None and has_pipeline(scene) else run
        if trained is None and scene is None:
            if model.is_dir() and not located(model).is_file():
                raise _no_model(model)
            if not model.exists():
                raise DataError(f"{model}: not found; expected a model file or a run folder")
            raise ConfigError(
                f"{model}: a model file does not name its scene; give the folder of a scene, or a run folder"
            )
        settings = load(str(trained / PIPELINE)).settings.scene if trained is not None else SceneSettings()
        file = shown_of_run(model) if run == model else model
        if run == model and not file.is_file():
            raise _no_model(model, file.name)
        given = scene if scene is not None else run or model
        folder = photographs_of(given)
        name = scene_name(settings.path if settings.path and has_pipeline(given) else folder)
        return cls(file, folder, settings, name, settings.alpha)

    def scene(self, model: Model | FieldModel) -> Scene:
        """Read the photographs as the model was trained on, at their full size."""
        found = self.settings.masked(read_scene(self.folder, self.settings.split))
        return found.with_alpha(self.alpha or model.rendering.alpha)


def require_model(path: Path) -> None:
    """Raise DataError for a folder that holds no Gaussians, and for the file of a field."""
    refuse_field(path)
    if path.is_dir() and not (file := model_at(path)).is_file():
        raise _no_model(path, file.name)


def _no_model(folder: Path, name: str = MODEL) -> DataError:
    """The error of a folder without a model, with the remedy for what it is."""
    if _has_field(folder):
        return DataError(f"{folder}: has no file of its field; run its pipeline again with the stage export_field")
    if has_pipeline(folder):
        return DataError(f"{folder}: has no {name}; finish the run with `clsplat resume {in_shell(folder)}`")
    fault = f"{folder}: has no {PIPELINE}; expected a model file or a run folder"
    if any(map(is_image, chain(folder.glob("*"), folder.glob("images/*")))):
        return DataError(
            f"{fault}; for a model of its photographs, run `clsplat run photos --scene {in_shell(folder)}` first"
        )
    return DataError(fault)


def refuse_field(path: Path) -> None:
    """Raise DataError for the file of a field, and for a run that has trained one."""
    if is_field(path) or (has_pipeline(path) and _has_field(path) and not model_of_run(path).is_file()):
        raise of_a_field(path)


def of_a_field(path: Path) -> DataError:
    """The error of a field where Gaussians are expected."""
    shown = "`clsplat render` makes pictures of it where a stage export_field has written it, with --video a film"
    return DataError(f"{path}: is a field, a network in the place of Gaussians; expected Gaussians: {shown}")


def shown_of_run(run: Path) -> Path:
    """The file of what a run has trained: Gaussians, or a field."""
    file = model_of_run(run)
    return file if file.is_file() or not _has_field(run) else field_of_run(run)


def _has_field(run: Path) -> bool:
    """Whether a run that is done has trained a field in the place of Gaussians."""
    try:
        return read_metrics(run / METRICS).gaussians is None
    except DataError:
        return False


def run_of(model: Path) -> Path | None:
    """Return the folder of the run that a model is of: itself, or one that has exported the file; None without one."""
    if model.is_dir():
        return model if has_pipeline(model) else None
    file = model.resolve()
    for folder in filter(has_pipeline, file.parents):
        with suppress(ConfigError):
            if file in {path for stage in _exports(load(str(folder / PIPELINE))) for path in stage.outputs(folder)}:
                return folder
    return None


def photographs_of(scene: Path) -> Path:
    """Return the folder of a scene: of a run that of the photographs it was trained on, else the folder itself.

    Raises ConfigError for a run whose pipeline names none or cannot be read, DataError where the folder is missing.
    """
    if not has_pipeline(scene):
        return scene
    prepared = noted(scene)
    folder = Path(prepared["folder"]) if prepared else load(str(scene / PIPELINE)).settings.scene.folder
    if not folder.is_dir():
        raise DataError(f"{scene}: the folder of its photographs, {folder}, is missing; give the folder of a scene")
    return folder


def _exports(pipeline: Pipeline) -> list[Export | ExportField]:
    stages = [part for stage in pipeline.stages for part in (stage, *getattr(stage, "during", ()))]
    return [stage for stage in stages if isinstance(stage, Export | ExportField)]


def overrides_of(overrides: Sequence[str], scene: Path | None) -> list[str]:
    """Return `overrides` with the folder of the photographs, where one is given.  Raises ConfigError, DataError."""
    return [*overrides, *([f"scene.path={as_setting(photographs_of(scene))}"] if scene is not None else [])]


def as_setting(folder: Path) -> str:
    """A folder as a value of `--set`, from wherever it is used.  Raises ConfigError when YAML cannot hold its name."""
    path = str(folder.resolve())
    try:
        path.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"--scene {path!r}: expected a path of UTF-8 text; rename the folder") from None
    return json.dumps(path)
