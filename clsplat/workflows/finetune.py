"""Fine-tune a model file on the photos of its scene, with stages of the recipe `compress`."""

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from clsplat.core import lock
from clsplat.core.errors import ConfigError, DataError, Interrupted
from clsplat.core.files import (
    LOCK,
    PIPELINE,
    make_folder,
    path_exists,
    raising_output_error,
    remove_partial_files,
    write_text,
)
from clsplat.core.reading import read_json
from clsplat.gaussians.model import MODEL, Model
from clsplat.metrics.views import mean, measure
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photographs
from clsplat.pipeline.files import find
from clsplat.pipeline.loading import Pipeline, check_document
from clsplat.pipeline.stretching import stretch
from clsplat.pipeline.yaml_file import Document, read_yaml
from clsplat.render.painter import SplatPainter
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.model_file import ModelFile, ModelSource
from clsplat.runs.run_folder import Start
from clsplat.runs.state import RunState
from clsplat.scene.identity import Identity, decode_all, require_decodable
from clsplat.sweeps.experiment import run_pipeline
from clsplat.sweeps.store import CellAttempt, readable_checkpoints

LOG = logging.getLogger("clsplat")
RECIPE, TRAINING = "compress", "optimize"
MIN_STEPS = 20  # so that each training of the recipe has steps to average over


@dataclass(frozen=True)
class Tuning:
    """The photos, rendering settings, and number of steps for fine-tuning."""

    name: str  # name of the pipelines
    source: ModelSource
    model: Model
    steps: int | None  # None: steps of the recipe
    device: Device

    def pipeline(self, stages: Sequence[str], values: Mapping[str, Any], **export: str) -> Pipeline:
        """Return a pipeline of the recipe's stages with these names, followed by an export stage.

        values: settings by key path; export: settings of the export stage.
        """
        path = find(RECIPE)
        data = read_yaml(path).data
        stage_data = [*_select_stages(data["stages"], stages), {"export": {"file": MODEL, "sky": "sidecar", **export}}]
        document = Document({**data, "name": self.name, "stages": stage_data})
        settings = {**self._scene_settings(), **self._rendering_settings(), **values}
        pipeline = check_document(path, document, [f"{key}={json.dumps(value)}" for key, value in settings.items()])
        if self.steps is None:
            return pipeline
        recipe_steps = next(stage for stage in data["stages"] if _has_name(stage, TRAINING))[TRAINING]["steps"]
        return replace(pipeline, settings=stretch(pipeline.settings, Fraction(self.steps, recipe_steps)))

    def train(self, pipeline: Pipeline, folder: Path, file: str = MODEL) -> Path:
        """Call `train_in_folder` with the device of the model."""
        return train_in_folder(pipeline, folder, self.device, file)

    def _scene_settings(self) -> dict[str, Any]:
        settings, rendering = self.source.settings, self.model.rendering
        return {
            "scene.path": str(self.source.folder.resolve()),
            "scene.downscale": settings.downscale,
            "scene.holdout": settings.holdout,
            "scene.alpha": self.source.alpha or rendering.alpha,
            "scene.background": rendering.background or settings.background,
        }

    def _rendering_settings(self) -> dict[str, Any]:
        rendering = self.model.rendering
        screen = {"type": "dilation", "variance": rendering.screen_variance, "compensate": int(rendering.compensate)}
        if rendering.pixel_box:
            screen = {"type": "box"}
        sky = self.model.sky and {"type": "envmap", "side": self.model.sky.side}
        return {
            "model.sh_degree": self.model.sh_degree,
            "model.near": self.model.near,
            "model.screen_filter": screen,
            **({"model.background": sky} if sky else {}),
        }


def train_in_folder(pipeline: Pipeline, folder: Path, device: Device, file: str = MODEL) -> Path:
    """Run a pipeline in a folder; return the path of `file` in the folder, which the pipeline writes.

    A finished run is kept, an interrupted one resumes, and missing files are restored.  If all checkpoints are damaged,
    the run starts over.
    """
    state = RunState.read(folder)
    if not state.is_complete(pipeline):
        is_resumable = any(readable_checkpoints([CellAttempt(folder)]))
        if state.checkpoints and not is_resumable:
            LOG.warning("%s: no checkpoint is intact; training starts over", folder)
        start: Start = "new" if not path_exists(folder) else "resume" if is_resumable else "restart"
        try:
            run_pipeline(pipeline, state, device, start)
        except Interrupted as error:
            raise Interrupted(f"stopped in {folder.name}; run the same command again to resume") from error
    return folder / file


def is_trained(pipeline: Pipeline, folder: Path) -> bool:
    """Return whether a folder has a finished run of a pipeline with all files intact."""
    return RunState.read(folder).is_complete(pipeline)


def require_steps(steps: int) -> None:
    """Raise ConfigError for fewer steps than the recipe needs."""
    if steps < MIN_STEPS:
        raise ConfigError(f"--steps {steps}: expected at least {MIN_STEPS}")


def _select_stages(stages: Iterable[Any], names: Iterable[str]) -> list[Any]:
    """Return the stages with these names, in order.  Their start steps count from the first of these stages."""
    selection, stage_iterator, earlier_steps = [], iter(stages), 0
    for name in names:
        while not _has_name(stage := next(stage_iterator), name):
            earlier_steps += stage[TRAINING]["steps"] if _has_name(stage, TRAINING) else 0
        selection.append(_shift_start(stage, earlier_steps) if _has_name(stage, TRAINING) else stage)
    return selection


def _shift_start(training: Any, steps: int) -> Any:
    """Subtract `steps` from the start steps of a training stage's inner stages, which count from the run's start."""
    keys = training[TRAINING]
    during = [
        {name: {**inner, **({"start": inner["start"] - steps} if "start" in inner else {})}}
        for stage in keys.get("during", ())
        for name, inner in stage.items()
    ]
    return {TRAINING: {**keys, "during": during}}


def _has_name(stage: Any, name: str) -> bool:
    """Return whether a stage of a pipeline file has this name.  stage: a string or a mapping."""
    return bool(stage == name or (isinstance(stage, dict) and name in stage))


# A folder in which models are trained for one set of inputs, so that interrupted work can resume.

LABELS = {"sha256": "model bytes"}  # names of identity keys in messages


@contextmanager
def claim_folder(out: Path, identity: dict[str, Any], record: str, content: str, remedy: str) -> Iterator[None]:
    """Create and lock a folder, write the identity of the work to a record, and remove files of killed processes.

    identity: inputs and options of the work, by key; content: a noun for messages, such as "a search"; remedy: the
    alternative to this folder, such as "another --out".
    Raises ConfigError if the folder contains other work or other files, and OutputError if another process uses it.
    """
    _require_same_identity(out, identity, record, content, remedy)
    with raising_output_error(out):
        make_folder(out)
    with lock.lock_folder(out):
        # again, because another process may have started
        _require_same_identity(out, identity, record, content, remedy)
        remove_partial_files(out, marker=PIPELINE)
        if not (out / record).exists():
            write_text(out / record, json.dumps(identity, indent=1) + "\n")
        yield


def _require_same_identity(out: Path, identity: dict[str, Any], record: str, content: str, remedy: str) -> None:
    """Raise ConfigError if a folder has a record of other inputs, or has files but no record."""
    if not path_exists(out / record):
        if path_exists(out) and not (out.is_dir() and all(_is_leftover(path.name) for path in out.iterdir())):
            raise ConfigError(f"{out}: contains files that are not part of {content}; use {remedy}")
        return
    try:
        previous = read_json(out / record)
    except DataError:
        previous = None
    if not isinstance(previous, dict):
        raise ConfigError(f"{out / record}: is not the record of {content}; remove {out}, or use {remedy}")
    changed_keys = [LABELS.get(key, key) for key, value in identity.items() if previous.get(key) != value]
    if changed_keys:
        changes = ", ".join(changed_keys)
        raise ConfigError(f"{out}: has {content} with different {changes}; remove the folder, or use {remedy}")


def _is_leftover(name: str) -> bool:
    """Return whether a file may be left over from a process that was killed early: a lock or a hidden file."""
    return name == LOCK or name[0] == "."


# Measuring models at the views of a scene.


class Measurer:
    """Measures models at the test views of a scene, or at its training views if there are no test views."""

    def __init__(self, model_file: ModelFile) -> None:
        self.model_file = model_file
        self.split = "test" if model_file.scene.split("test") else "train"
        if self.split == "train":
            LOG.warning(
                "%s: has no test views, so the training views are evaluated; hold out test views with scene.holdout",
                model_file.scene.path,
            )
        self.rasterizer = Rasterizer(model_file.device)
        self.photographs = Photographs(model_file.device, model_file.background)

    def identity(self) -> str:
        """Return a hash of the photos, cameras, and points.  Raises DataError if a photo is damaged."""
        scene = self.model_file.scene
        files = decode_all(scene.views)
        require_decodable(scene.path, files)
        return Identity.from_scene(scene, files).digest

    def mean_metrics(self, model: Model) -> tuple[float, float]:
        """Return the mean PSNR in dB and the mean SSIM of a model."""
        views, scene_model = self.model_file.scene.split(self.split), model.in_scene(self.model_file.scene)
        painter = SplatPainter(self.rasterizer, scene_model.upload(self.model_file.device), self.photographs.background)
        results = measure(painter, views, self.photographs)
        averages = mean(results)
        return averages["psnr"], averages["ssim"]
