"""A model at the views of a scene: rendering and measuring without training."""

import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.conformance.quick import open_correct
from clsplat.errors import ConfigError, DataError
from clsplat.files import atomic, is_there, write_text
from clsplat.gaussians.model import load
from clsplat.metrics.images import to_8_bits
from clsplat.metrics.lpips import InputRange
from clsplat.metrics.perceptual import Perceptual, metric_names
from clsplat.metrics.views import PSNR_AND_SSIM, mean, measure, render_floats, require_finite
from clsplat.opencl.device import Device
from clsplat.reading import read_json
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.source import Source
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.stages.render import image_paths
from clsplat.views.photographs import Photographs

SPLITS = ("train", "test", "all")
KINDS = ("png", "npy")  # of files
RECORD = ".renders.json"  # beside renders: their names


class ModelFile:
    """A model opened on a device, with the scene whose cameras look at it.

    The numbers it was trained with come from the file's comment; files of other programs get those of 3DGS, or of
    Mip-Splatting where the file says so.  Photographs of a run folder are read as the run read them.
    """

    def __init__(
        self, model: Path, scene: Path | None = None, device: str | Device | None = None, downscale: float | None = None
    ) -> None:
        """downscale: divisor of the photographs' size; default: that of the run, 1 for a file."""
        source = Source.of(model, scene)
        file = load(source.file)
        self.device = open_correct(device)
        alpha = source.alpha or file.rendering.alpha
        self.photographs = read_scene(source.folder, source.settings.holdout).with_alpha(alpha)
        self.downscale = downscale or source.settings.downscale
        self.scene = self.photographs.downscaled(self.downscale)
        self.model = file.upload(self.device)
        self.background = file.rendering.background or self.scene.background
        self.rasterizer = Rasterizer(self.device)

    def render(self, split: str, out: Path, kind: str) -> int:
        """Write an image (`kind` png) or float32 array (npy) for each view of a split; return their number."""
        photographs = Photographs(self.device, self.background)
        views = self.scene.split(split)
        if not views:
            raise DataError(f"{self.scene.path}: has no {split} views")
        paths = image_paths(out, [view.name for view in views], f".{kind}")
        images = [view.image_path for split in ("train", "test") for view in self.photographs.split(split)]
        _check_folder(out, paths, images)
        names = [path.relative_to(out).as_posix() for path in paths]
        write_text(out / RECORD, json.dumps(sorted({*_rendered(out), *names}), indent=1) + "\n")
        for path, view in zip(paths, views, strict=True):
            image = render_floats(self.rasterizer, self.model, photographs.camera(view), photographs.background)
            require_finite(image, view)
            if kind == "png":
                write_image(path, to_8_bits(image))
            else:
                buffer = io.BytesIO()
                np.save(buffer, image, allow_pickle=False)
                with atomic(path) as stream:
                    stream.write(buffer.getvalue())
        return len(views)

    def evaluate(
        self, downscales: Sequence[float] | None = None, perceptual: Perceptual = PSNR_AND_SSIM
    ) -> dict[str, Any]:
        """Return metrics by split and divisor of the photographs' size, with the keys of metrics.json."""
        metrics: dict[str, Any] = {"test": {}, "train": {}}
        for downscale in downscales or [self.downscale]:
            scene = self.photographs.downscaled(downscale)
            photographs = Photographs(self.device, self.background)
            for split in ("test", "train"):
                if scene.split(split):
                    views = scene.split(split)
                    results = measure(self.rasterizer, self.model, views, photographs, perceptual, finite=True)
                    metrics[split][f"{downscale:g}"] = mean(results, perceptual)
        return {**metrics, "gaussians": self.model.gaussians.count, "device": self.device.text}


def _check_folder(out: Path, paths: Sequence[Path], photographs: Sequence[Path]) -> None:
    """Raise ConfigError where renders would mix with photographs, or replace what no earlier call has rendered."""
    folder = out.resolve()
    for images in {path.resolve().parent for path in photographs}:
        if folder == images or folder in images.parents or images in folder.parents:
            raise ConfigError(
                f"{out}: is, holds or lies in the folder of the photographs, {images}; give another --out"
            )
    own = _rendered(out)
    for path in paths:
        if is_there(path) and path.relative_to(out).as_posix() not in own:
            raise ConfigError(f"{path}: exists, and is no render of an earlier call; give another --out")


def _rendered(out: Path) -> list[str]:
    """The files that earlier calls have rendered into a folder."""
    try:
        names = read_json(out / RECORD)
    except DataError:
        return []
    return [name for name in names if isinstance(name, str)] if isinstance(names, list) else []


def render(
    model: Path,
    scene: Path | None = None,
    out: Path = Path("renders"),
    *,
    split: str = "test",
    downscale: float | None = None,
    kind: str = "png",
    device: str | Device | None = None,
) -> int:
    """Render a model file or run folder at the views of a scene; return the number of files.  Raises ClsplatError."""
    for what, value, known in (("split", split, SPLITS), ("kind", kind, KINDS)):
        if value not in known:
            raise ConfigError(f"no {what} '{value}'; there are {', '.join(known)}")
    return ModelFile(model, scene, device, downscale).render(split, out, kind)


def evaluate(
    model: Path,
    scene: Path | None = None,
    *,
    downscales: Sequence[float] | None = None,
    metrics: Sequence[str] = ("psnr", "ssim"),
    lpips: Path | None = None,
    lpips_input: InputRange = "-1..1",
    device: str | Device | None = None,
) -> dict[str, Any]:
    """Measure a model file or run folder on a scene's views, with the keys of metrics.json.  Raises ClsplatError."""
    if wrong := [value for value in downscales or () if not 1 <= value < math.inf]:
        raise ConfigError(f"expected downscale factors from 1 on, got {wrong[0]:g}")
    perceptual = Perceptual.open(metric_names(list(metrics)), lpips, lpips_input)
    return ModelFile(model, scene, device).evaluate(downscales, perceptual)
