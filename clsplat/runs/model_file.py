"""A model, or a field, at the views of a scene: rendering and measuring without training."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from clsplat.conformance.quick import open_correct
from clsplat.errors import ConfigError, DataError
from clsplat.gaussians.model import Model
from clsplat.metrics.lpips import InputRange
from clsplat.metrics.perceptual import Perceptual, metric_names
from clsplat.metrics.views import PSNR_AND_SSIM, mean, measure
from clsplat.opencl.device import Device
from clsplat.render.painter import Painter
from clsplat.runs.loaded import moves, painter_of, read, size_of
from clsplat.runs.pictures import KINDS, write_pictures
from clsplat.runs.source import Source, of_a_field
from clsplat.scene.view import View
from clsplat.training.colours import colours_beside
from clsplat.training.field_file import FieldModel
from clsplat.training.poses import poses_beside
from clsplat.video.moments import require_motion, times_of
from clsplat.video.pictures import LAYERS, Canvas
from clsplat.views.photographs import Photographs

SPLITS = ("train", "test", "all")


class ModelFile:
    """A model opened on a device, with the scene whose cameras look at it.

    The numbers it was trained with come from the file's comment; files of other programs get those of 3DGS, or of
    Mip-Splatting where the file says so.  Photographs of a run folder are read as the run read them.
    """

    def __init__(
        self, model: Path, scene: Path | None = None, device: str | Device | None = None, downscale: float | None = None
    ) -> None:
        """downscale: divisor of the photographs' size; default: that of the run, 1 for a file."""
        self.source = Source.of(model, scene)
        self.loaded = read(self.source.file)
        self.device = open_correct(device)
        found = self.source.scene(self.loaded)
        self.photographs = poses_beside(self.source.file, found) if scene is None else found
        self.downscale = self.source.settings.downscale if downscale is None else downscale
        self.scene = self.photographs.downscaled(self.downscale)
        self.background = self.loaded.rendering.background or self.scene.background
        self.colours = colours_beside(self.source.file)

    @property
    def gaussians(self) -> Model:
        """The model.  Raises DataError where it is a field."""
        if isinstance(self.loaded, FieldModel):
            raise of_a_field(self.source.file)
        return self.loaded

    @cached_property
    def painter(self) -> Painter:
        """What renders it on the device."""
        return painter_of(self.loaded, self.device, self.background)

    def render(
        self, split: str, out: Path, kind: str, layers: Sequence[str] = LAYERS[:1], time: float | None = None
    ) -> int:
        """Write images (`kind` png) or float32 arrays (npy) of layers of the views of a split; return their number.

        time: of all views, in [0, 1], instead of their own.
        """
        views: Sequence[View] = self.scene.split(split)
        if times := times_of(time):
            require_motion(moves(self.loaded))
            views = [replace(view, time=times[0]) for view in views]
        if not views:
            raise DataError(f"{self.scene.path}: has no {split} views")
        images = [view.image_path for split in ("train", "test") for view in self.photographs.split(split)]
        return len(write_pictures(Canvas(self.painter), views, out, kind, layers, images))

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
                    results = measure(
                        *(self.painter, views, photographs, perceptual),
                        finite=True,
                        colours=self.colours,
                        trained=scene.split("train"),
                    )
                    metrics[split][f"{downscale:g}"] = mean(results, perceptual)
        return {**metrics, **size_of(self.loaded), "device": self.device.text}


def render(
    model: Path,
    scene: Path | None = None,
    out: Path = Path("renders"),
    *,
    split: str = "test",
    downscale: float | None = None,
    kind: str = "png",
    layers: Sequence[str] = LAYERS[:1],
    time: float | None = None,
    device: str | Device | None = None,
) -> int:
    """Render a model file or run folder at the views of a scene; return the number of files.  Raises ClsplatError."""
    for what, value, known in (("split", split, SPLITS), ("kind", kind, KINDS)):
        if value not in known:
            raise ConfigError(f"no {what} '{value}'; there are {', '.join(known)}")
    return ModelFile(model, scene, device, downscale).render(split, out, kind, layers, time)


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
