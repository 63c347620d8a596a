"""Render and measure a model, or a field, at the views of a scene, without training."""

import io
import json
import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.conformance.quick import open_verified
from clsplat.core.errors import ConfigError, DataError, quote, shell_quote
from clsplat.core.files import METRICS, PIPELINE, open_atomic, path_exists, raising_output_error, write_text
from clsplat.core.progress import counted
from clsplat.core.reading import read_json
from clsplat.formats.table import model_file
from clsplat.gaussians.model import MODEL, Model, load, model_path, run_model_path
from clsplat.metrics.perceptual import Perceptual
from clsplat.metrics.views import PSNR_AND_SSIM, mean, measure
from clsplat.nerf.files import FieldModel, find_field, is_field, load_field
from clsplat.opencl.device import Device
from clsplat.photos.photographs import Photographs
from clsplat.pipeline.file import SceneSettings
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.prepare.cache import read_summary
from clsplat.render.painter import Painter, SplatPainter
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.results import read_metrics
from clsplat.runs.state import has_pipeline
from clsplat.scene import camera_files
from clsplat.scene.detect import read_scene
from clsplat.scene.images import is_image, write_image
from clsplat.scene.scene import HOLDOUT, Background, Scene, scene_name
from clsplat.scene.view import Alpha, View
from clsplat.stages.export import Export
from clsplat.stages.render import image_paths
from clsplat.stages.train_field import ExportField
from clsplat.training.modules.base import apply_side_files, read_color_model
from clsplat.viewer.video.frames import DEPTH_LAYERS, LAYERS, Canvas, layer_image, layer_values
from clsplat.viewer.video.plan import parse_times, require_motion

# Models on the host: Gaussians, or a field.

AnyModel = Model | FieldModel


def read(file: Path) -> AnyModel:
    """Read a model file or a field file.  Raises DataError if it is missing, damaged, or of another format."""
    return load_field(file) if is_field(file) else load(file)


def make_painter(host_model: AnyModel, device: Device, background: Background) -> Painter:
    """Return a painter for a model on a device.  background: the color behind Gaussians; field files contain theirs."""
    if isinstance(host_model, FieldModel):
        return host_model.upload(device)
    return SplatPainter(Rasterizer(device), host_model.upload(device), Photographs(device, background).background)


def content_points(host_model: AnyModel, scene: Scene | None) -> NDArray[np.float32]:
    """Return points of the visible content, (M, 3): the means of Gaussians, or for a field the points of the scene.

    M is 0 for a field without scene points.
    """
    if isinstance(host_model, Model):
        return host_model.scene_means
    points = scene.points if scene else None
    return np.zeros((0, 3), np.float32) if points is None else points.positions


def is_moving(host_model: AnyModel) -> bool:
    """Return whether a model is a set of Gaussians with motion."""
    return isinstance(host_model, Model) and host_model.motion is not None


def _count_parameters(host_model: AnyModel) -> dict[str, int | None]:
    """Return the number of Gaussians or of network parameters, under the keys that metrics.json uses."""
    if isinstance(host_model, Model):
        return {"gaussians": len(host_model)}
    return {"gaussians": None, "parameters": host_model.shape.parameter_count}


# The model and the photos of a command, given as a file, a dataset folder, or a run folder.


@dataclass(frozen=True)
class ModelSource:
    """A model file, and the dataset at whose views the model is rendered and measured."""

    file: Path
    folder: Path  # dataset folder, with the photos and cameras
    settings: SceneSettings  # settings for reading the dataset
    scene_name: str  # shown on pages
    alpha: Alpha | None = None  # None: use the value in the model file

    @classmethod
    def from_model(cls, model: Path, scene: Path | None) -> "ModelSource":
        """Find the dataset of a run folder, or of a file that a run exported.  Other model files need `scene`.

        scene: a dataset folder or run folder whose photos replace those of the model's run.  Raises DataError if a
        file is missing, and ConfigError if the scene is unknown.
        """
        run = find_run(model)
        folder = scene if scene is not None and has_pipeline(scene) else run
        if folder is None and scene is None:
            if model.is_dir() and not model_file(model).is_file():
                raise _missing_model_error(model)
            if not model.exists():
                raise DataError(f"{model}: not found; expected a model file or a run folder")
            raise ConfigError(
                f"{model}: a model file does not name its scene; pass the folder of the scene, or a run folder"
            )
        settings = load_pipeline(str(folder / PIPELINE)).settings.scene if folder is not None else SceneSettings()
        file = trained_file(model) if run == model else model
        if run == model and not file.is_file():
            raise _missing_model_error(model, file.name)
        source = scene if scene is not None else run or model
        folder = photo_folder(source)
        name = scene_name(settings.path if settings.path and has_pipeline(source) else folder)
        return cls(file, folder, settings, name, settings.alpha)

    def scene(self, model: Model | FieldModel) -> Scene:
        """Read the scene at full image size, with the masks and alpha mode that the model was trained with."""
        masked_scene = self.settings.apply_masks(read_scene(self.folder, self.settings.split))
        return masked_scene.with_alpha(self.alpha or model.rendering.alpha)


def is_model_alone(path: Path) -> bool:
    """Return whether a path is a file of Gaussians that no run exported, so that its scene is unknown."""
    return model_file(path).is_file() and not is_field(path) and find_run(path) is None


def require_model(path: Path) -> None:
    """Raise DataError if a path is a field file, or a folder without a model of Gaussians."""
    refuse_field(path)
    if path.is_dir() and not (file := model_path(path)).is_file():
        raise _missing_model_error(path, file.name)


def _missing_model_error(folder: Path, name: str = MODEL) -> DataError:
    """Return the error for a folder without a model.  The remedy depends on whether it contains a run or photos."""
    if _has_field(folder):
        return DataError(f"{folder}: its field file is missing; run its pipeline again with the stage export_field")
    if has_pipeline(folder):
        return DataError(f"{folder}: has no {name}; finish the run with `clsplat resume {shell_quote(folder)}`")
    fault = f"{folder}: has no {PIPELINE}; expected a model file or a run folder"
    if any(map(is_image, chain(folder.glob("*"), folder.glob("images/*")))):
        return DataError(
            f"{fault}; to train a model on its photos, run `clsplat run photos --scene {shell_quote(folder)}` first"
        )
    return DataError(fault)


def refuse_field(path: Path) -> None:
    """Raise DataError for a field file, and for a run that trained a field."""
    if is_field(path) or (has_pipeline(path) and _has_field(path) and not run_model_path(path).is_file()):
        raise field_error(path)


def field_error(path: Path) -> DataError:
    """Return the error for a field file that is used where Gaussians are expected."""
    remedy = "use `clsplat render` on the file that the stage export_field writes"
    return DataError(f"{path}: is a field, which has a network instead of Gaussians; {remedy}")


def trained_file(run: Path) -> Path:
    """Return the model file that a run trained: Gaussians, or a field."""
    file = run_model_path(run)
    return file if file.is_file() or not _has_field(run) else find_field(run)


def _has_field(run: Path) -> bool:
    """Return whether a finished run trained a field instead of Gaussians."""
    try:
        return read_metrics(run / METRICS).gaussians is None
    except DataError:
        return False


def find_run(model: Path) -> Path | None:
    """Return the run folder of a model; None if it is not from a run.

    model: the run folder itself, or a file that the run exported.
    """
    if model.is_dir():
        return model if has_pipeline(model) else None
    file = model.resolve()
    for folder in filter(has_pipeline, file.parents):
        with suppress(ConfigError):
            if file in {
                path for stage in _list_exports(load_pipeline(str(folder / PIPELINE))) for path in stage.outputs(folder)
            }:
                return folder
    return None


def photo_folder(scene: Path) -> Path:
    """Return the dataset folder of a scene.

    scene: the dataset folder, or a run folder whose pipeline contains the path of the dataset.  Raises ConfigError if
    that pipeline cannot be read or has no path, and DataError if the dataset folder is missing.
    """
    if not has_pipeline(scene):
        return scene
    summary = read_summary(scene)
    folder = Path(summary["folder"]) if summary else load_pipeline(str(scene / PIPELINE)).settings.scene.folder
    if not folder.is_dir():
        raise DataError(f"{scene}: the folder of its photos, {folder}, is missing; pass the folder of the scene")
    return folder


def _list_exports(pipeline: Pipeline) -> list[Export | ExportField]:
    stages = [item for stage in pipeline.stages for item in (stage, *getattr(stage, "during", ()))]
    return [stage for stage in stages if isinstance(stage, Export | ExportField)]


def with_scene_path(overrides: Sequence[str], scene: Path | None) -> list[str]:
    """Return `overrides` with `scene.path` added, if a scene is given.  Raises ConfigError, DataError."""
    return [*overrides, *([f"scene.path={path_setting(photo_folder(scene))}"] if scene is not None else [])]


def path_setting(folder: Path) -> str:
    """Format the absolute path of a folder as a value for `--set`.  Raises ConfigError if it is not valid Unicode."""
    path = str(folder.resolve())
    try:
        path.encode()
    except UnicodeEncodeError:
        raise ConfigError(f"--scene {path!r}: expected a path in UTF-8; rename the folder") from None
    return json.dumps(path)


# Renders in a folder, one file per view and layer.

FRAME = re.compile(r"frame_\d{5,6}(_[a-z]+)?\.[a-z]+")  # video frames; those of the path `views` are named like views
LOG = logging.getLogger("clsplat")
FORMATS = ("png", "npy")
RECORD = ".renders.json"  # in the folder of renders: the name of each render, and whether it is a frame of a video


def write_renders(
    canvas: Canvas,
    views: Sequence[View],
    out: Path,
    file_format: str,
    layers: Sequence[str],
    photographs: Sequence[Path],
    is_video: bool = False,
) -> list[Path]:
    """Write the layers of each view as images (png) or float32 arrays (npy); return the paths of the files.

    File names end in the name of the layer, except for color.  photographs: photo files, whose folders must not be
    written to.  is_video: whether the views are frames of a video; if so, frames of earlier videos are removed.
    """
    color_paths = image_paths(out, [view.name for view in views], f".{file_format}")
    files = [{layer: _layer_path(path, layer) for layer in layers} for path in color_paths]
    paths = [path for layer_files in files for path in layer_files.values()]
    if len(set(paths)) < len(paths):
        duplicate = Counter(paths).most_common(1)[0][0].relative_to(out).as_posix()
        remedy = "rename one of these views, or render fewer layers"
        raise ConfigError(f"{out}: two renders would be named {quote(duplicate)}; {remedy}")
    _check_folder(out, paths, photographs)
    names = [path.relative_to(out).as_posix() for path in paths]
    record = {**_read_record(out), **dict.fromkeys(names, is_video)}
    _write_record(out, record)
    has_range = file_format == "png" and not DEPTH_LAYERS.isdisjoint(layers)
    depths = canvas.depth_range(views) if has_range else (0.0, 0.0)
    for view, layer_files in counted(zip(views, files, strict=True), "views rendered", len(views)):
        buffers = canvas.render_layers(view, layers)
        for layer, path in layer_files.items():
            if file_format == "png":
                write_image(path, layer_image(buffers, layer, depths))
            else:
                _write_array(path, layer_values(buffers, layer))
    if is_video:
        _remove_frames(
            out, {name for name, is_frame in record.items() if is_frame and name.endswith(f".{file_format}")} - {*names}
        )
    return paths


def _remove_frames(out: Path, frames: set[str]) -> None:
    """Remove frames of an earlier video from a folder and from its record."""
    with raising_output_error(out):
        for name in frames:
            (out / name).unlink(missing_ok=True)
    _write_record(out, {name: is_frame for name, is_frame in _read_record(out).items() if name not in frames})
    if frames:
        LOG.info("%s: removed %d frames of an earlier video", out, len(frames))


def _layer_path(path: Path, layer: str) -> Path:
    return path if layer == LAYERS[0] else path.with_name(f"{path.stem}_{layer}{path.suffix}")


def _write_array(path: Path, array: NDArray[np.float32]) -> None:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    with open_atomic(path) as stream:
        stream.write(buffer.getvalue())


def _check_folder(out: Path, paths: Sequence[Path], photographs: Sequence[Path]) -> None:
    """Raise ConfigError if renders would be written among photos, or would replace files that are not renders."""
    folder = out.resolve()
    for images in {path.resolve().parent for path in photographs}:
        if folder == images or folder in images.parents or images in folder.parents:
            raise ConfigError(
                f"{out}: is, contains, or is inside the folder of the photos, {images}; use another --out"
            )
    renders = _read_record(out)
    for path in paths:
        if path_exists(path) and path.relative_to(out).as_posix() not in renders:
            raise ConfigError(f"{path}: exists, and is not from an earlier render; use another --out")


def _read_record(out: Path) -> dict[str, bool]:
    """Read the record of earlier renders in a folder: for each file name, whether it is a frame of a video."""
    try:
        record = read_json(out / RECORD)
    except DataError:
        return {}
    entries = record if isinstance(record, dict) else {}
    return {name: is_frame is True and FRAME.fullmatch(name) is not None for name, is_frame in entries.items()}


def _write_record(out: Path, record: Mapping[str, bool]) -> None:
    write_text(out / RECORD, json.dumps(record, indent=1, sort_keys=True) + "\n")


SPLITS = ("train", "test", "all")


class ModelFile:
    """A model on a device, with its scene.

    The header of the model file contains the rendering settings.  Files of other programs use the settings of 3DGS, or
    of Mip-Splatting if the header says so.  The photos of a run folder are read with the settings of the run.
    """

    def __init__(
        self, model: Path, scene: Path | None = None, device: str | Device | None = None, downscale: float | None = None
    ) -> None:
        """downscale: divisor of the image size; default: that of the run, or 1 for a file."""
        self.source = ModelSource.from_model(model, scene)
        host_model = read(self.source.file)
        self.device = open_verified(device)
        original = self.source.scene(host_model)
        self.host_model = host_model.in_scene(original)
        self.photographs = apply_side_files(self.source.file, original) if scene is None else original
        self.downscale = self.source.settings.downscale if downscale is None else downscale
        self.scene = self.photographs.downscaled(self.downscale)
        self.background = self.host_model.rendering.background or self.scene.background
        self.colors = read_color_model(self.source.file)

    @property
    def gaussians(self) -> Model:
        """The Gaussians of the model.  Raises DataError for a field."""
        if isinstance(self.host_model, FieldModel):
            raise field_error(self.source.file)
        return self.host_model

    @cached_property
    def painter(self) -> Painter:
        """The painter that renders the model on the device."""
        return make_painter(self.host_model, self.device, self.background)

    def render(
        self, split: str, out: Path, file_format: str, layers: Sequence[str] = LAYERS[:1], time: float | None = None
    ) -> int:
        """Render the views of a split, and write their layers as images (png) or float32 arrays (npy).

        time: timestamp in [0, 1] for all views; None: use the timestamp of each view.  Returns the number of files.
        """
        views: Sequence[View] = self.scene.split(split)
        if times := parse_times(time):
            require_motion(is_moving(self.host_model))
            views = [replace(view, time=times[0]) for view in views]
        if not views:
            raise DataError(f"{self.scene.path}: has no {split} views; use another --split")
        images = [view.image_path for split in ("train", "test") for view in self.photographs.split(split)]
        return len(write_renders(Canvas(self.painter), views, out, file_format, layers, images))

    def evaluate(
        self, downscales: Sequence[float] | None = None, perceptual: Perceptual = PSNR_AND_SSIM
    ) -> dict[str, Any]:
        """Return metrics by split and downscale factor, with the keys of metrics.json."""
        metrics: dict[str, Any] = {"test": {}, "train": {}}
        for downscale in downscales or [self.downscale]:
            scene = self.photographs.downscaled(downscale)
            photographs = Photographs(self.device, self.background)
            for split in ("test", "train"):
                if scene.split(split):
                    views = scene.split(split)
                    results = measure(
                        *(self.painter, views, photographs, perceptual),
                        check_finite=True,
                        colors=self.colors,
                        train_views=scene.split("train"),
                    )
                    metrics[split][f"{downscale:g}"] = mean(results, perceptual)
        return {**metrics, **_count_parameters(self.host_model), "device": self.device.label}


def write_cameras(scene: Path | Scene, out: Path, format_: str, images: str = "none") -> list[Path]:
    """Write cameras in the format of another program; return the paths of the files.

    scene: a dataset folder, a `Scene`, or a run folder, to write its optimized cameras.  Raises ClsplatError.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; expected a folder to write into")
    if isinstance(scene, Path) and has_pipeline(scene):
        source = ModelSource.from_model(scene, None)
        used_scene = apply_side_files(source.file, read_scene(source.folder, source.settings.split))
    else:
        used_scene = scene if isinstance(scene, Scene) else read_scene(scene, HOLDOUT)
    return camera_files.write_cameras(used_scene, out, format_, images)
