"""Read a finished run from its folder: its settings, metrics, records, and renders."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from clsplat.core.errors import ConfigError, DataError, quote, shorten
from clsplat.core.files import METRICS, PIPELINE
from clsplat.core.reading import read_file
from clsplat.pipeline import plugins
from clsplat.pipeline.explanation import explain
from clsplat.pipeline.file import SceneSettings
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.prepare.cache import read_summary
from clsplat.runs.state import RunState
from clsplat.training.records import Records

Curve = list[tuple[float, float]]  # x and y of its points


class Averages(BaseModel):
    """Mean metrics over the views of a split at one image size; perceptual metrics are extra fields."""

    model_config = ConfigDict(extra="allow", allow_inf_nan=False)

    psnr: float
    ssim: float
    lpips: float | None = None
    views: int
    psnr_color_views: int | None = None  # number of views with a `psnr_color`; None: all views

    @property
    def color_views(self) -> int:
        """The number of views in the mean of `psnr_color`."""
        return self.views if self.psnr_color_views is None else self.psnr_color_views

    def value(self, metric: str) -> float | None:
        """Return a metric by its name; None if it was not measured."""
        value = getattr(self, metric, None)
        return float(value) if isinstance(value, int | float) else None


AveragesByDownscale = dict[Annotated[str, Field(pattern=r"^\d+(\.\d+)?$")], Averages]


class RunMetrics(BaseModel):
    """The content of metrics.json; values from stages and from the preparation are extra fields."""

    model_config = ConfigDict(extra="allow")

    test: AveragesByDownscale
    train: AveragesByDownscale
    gaussians: int | None  # None for a field
    sky_gaussians: int = 0  # additional Gaussians of the sky in exported files
    parameters: int | None = None  # number of network parameters of a field
    steps: int
    train_seconds: float
    cpu_seconds: float | None = None  # CPU time of the training, summed over threads
    device_memory: int | None = None  # peak allocation, bytes
    seed: int
    device: str
    pipeline: str
    files: dict[str, str] = {}  # first output of the last stage of each name, as a path in the run folder


@dataclass(frozen=True)
class RunFolder:
    """The folder of a finished run: settings, metrics, and records."""

    path: Path
    settings: dict[str, Any]  # the resolved pipeline, structured as in pipeline.yaml
    scene: SceneSettings
    metrics: RunMetrics

    @classmethod
    def read(cls, path: Path) -> "RunFolder":
        """Read a run folder.

        Raises DataError if it is missing, unfinished, or damaged, and ConfigError if its pipeline.yaml cannot be read.
        """
        state = RunState.read(path)
        if PIPELINE not in state.names:
            raise DataError(f"{path}: has no {PIPELINE}; expected the folder of a finished run")
        if METRICS not in state.names:
            raise DataError(f"{path}: has no {METRICS} because the run is {state.state_name}; finish it with --resume")
        settings = read_settings(path)
        return cls(path, settings, _parse_scene_settings(path, settings), read_metrics(path / METRICS))

    @property
    def plugin_faults(self) -> list[str]:
        """A message for each plug-in of the run that is not loaded, or has changed since the run."""
        recorded_plugins = self.settings.get("plugins")
        faults = plugins.differences(recorded_plugins) if isinstance(recorded_plugins, dict) else []
        return [f"{self.path}: {fault}" for fault in faults]

    @property
    def photo_folder(self) -> Path:
        """The folder of the photos that the run trained on.  Raises ConfigError if the pipeline names no scene."""
        summary = read_summary(self.path)
        return Path(summary["folder"]) if summary else self.scene.folder

    @cached_property
    def records(self) -> list[dict[str, Any]]:
        """The lines of metrics.jsonl; empty if it is missing.  Raises DataError if it is damaged."""
        return Records(self.path).read()

    def curve(self, kind: str, metric: str, **conditions: Any) -> Curve:
        """Return the points (step, metric) from all records of a kind, such as `train`, that match the conditions.

        conditions: values that a record must have, such as split="test".
        """
        records = (record for record in self.records if record["kind"] == kind)
        matches = (record for record in records if all(record.get(key) == value for key, value in conditions.items()))
        return [(record["step"], record[metric]) for record in matches if isinstance(record.get(metric), int | float)]

    def over_cpu_seconds(self, curve: Curve) -> Curve:
        """Convert a curve over steps to one over CPU seconds of training; empty if no CPU times were recorded."""
        times = [(0.0, 0.0), *self.curve("train", "cpu_seconds")]
        if len(times) == 1:
            return []
        steps, cpu_seconds = zip(*times, strict=True)
        return [(float(np.interp(step, steps, cpu_seconds)), value) for step, value in curve]

    @property
    def render_folder(self) -> Path:
        """The folder of images of the last `render` stage.  Raises DataError if it is outside the run folder."""
        stages = [stage["render"] for stage in self.settings["stages"] if isinstance(stage, dict) and "render" in stage]
        folder = str((stages[-1] or {}).get("folder", "renders")) if stages else "renders"
        if Path(folder).is_absolute() or ".." in Path(folder).parts:
            raise DataError(f"{self.path / PIPELINE}: render.folder is outside the run folder: {quote(folder)}")
        return self.path / folder


def read_settings(path: Path) -> dict[str, Any]:
    """Return the unvalidated content of a run's pipeline.yaml.  Raises ConfigError if it is not a pipeline."""
    data = read_yaml(path / PIPELINE).data
    if not isinstance(data, dict) or not isinstance(data.get("stages", []), list):
        raise ConfigError(f"{path / PIPELINE}: damaged; expected keys such as name and stages")
    return {"stages": [], **data}


def _parse_scene_settings(path: Path, settings: dict[str, Any]) -> SceneSettings:
    try:
        return SceneSettings.model_validate(settings.get("scene", {}))
    except ValidationError as error:
        file = path / PIPELINE
        raise ConfigError(explain(error, SceneSettings, file, read_yaml(file))) from error


def read_metrics(path: Path) -> RunMetrics:
    """Read a metrics.json file.  Raises DataError, which names the file and the key, if it is damaged."""
    try:
        return RunMetrics.model_validate_json(read_file(path))
    except ValidationError as error:
        first_error = error.errors()[0]
        key = shorten(".".join(str(item) for item in first_error["loc"]))
        message = shorten(first_error["msg"].removeprefix("Invalid JSON: "), 200)
        raise DataError(
            f"{path}: {key + ': ' if key else ''}{message}; the file is damaged: run the pipeline again"
        ) from error
