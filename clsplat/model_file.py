"""A model file at the views of a scene: rendering and measuring without a run."""

import io
import logging
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import DataError
from clsplat.files import atomic
from clsplat.filters import Dilation, Mip, ModelSettings
from clsplat.gaussians.ply import read_ply
from clsplat.gaussians.tables import Gaussians
from clsplat.metrics.perceptual import Perceptual
from clsplat.metrics.views import PSNR_AND_SSIM, mean, measure, render_view
from clsplat.opencl.device import Device, choose
from clsplat.render.rasterizer import Rasterizer
from clsplat.scene.detect import read_scene
from clsplat.scene.images import write_image
from clsplat.stages.render import image_path
from clsplat.views.photographs import BACKGROUNDS, Photographs

LOG = logging.getLogger("clsplat")


class ModelFile:
    """A PLY opened on a device, with the scene whose cameras look at it.

    The numbers it was trained with come from the file's comment; files of other programs get those of 3DGS, or of
    Mip-Splatting where the file says so.
    """

    def __init__(self, path: Path, scene: Path, device: str | None, scale: float = 1) -> None:
        file = read_ply(path)
        self.device = Device(choose(device))
        LOG.info("device: %s", self.device.text)
        self.photographs = read_scene(scene).with_alpha(
            "mask" if file.rendering.get("alpha") == "mask" else "transparency"
        )
        self.scene = self.photographs.downscaled(scale)
        gaussians = Gaussians(self.device, file.parameters)
        screen = Mip() if file.mode == "mip" else Dilation()
        self.model = ModelSettings(screen_filter=screen).model(gaussians, gaussians.sh_degree)
        for name in ("near", "screen_variance", "compensate"):
            if isinstance(file.rendering.get(name), int | float):
                setattr(self.model, name, float(file.rendering[name]))
        background = file.rendering.get("background")
        self.background = background if background in BACKGROUNDS else self.scene.background
        self.rasterizer = Rasterizer(self.device)

    def render(self, split: str, out: Path, kind: str) -> int:
        """Write an image for each view of a split; return their number."""
        photographs = Photographs(self.device, self.background)
        views = self.scene.split(split)
        if not views:
            raise DataError(f"{self.scene.path}: has no {split} views")
        for view in views:
            camera = photographs.camera(view)
            path = image_path(out, view.name, f".{kind}")
            if kind == "png":
                write_image(path, render_view(self.rasterizer, self.model, camera, photographs.background))
            else:
                frame = self.rasterizer.forward(self.model, camera, photographs.background)
                planes = frame.image.get()[:, : camera.height, : camera.width]
                buffer = io.BytesIO()
                np.save(buffer, np.ascontiguousarray(planes.transpose(1, 2, 0)), allow_pickle=False)
                with atomic(path) as stream:
                    stream.write(buffer.getvalue())
        return len(views)

    def evaluate(self, scales: list[float], perceptual: Perceptual = PSNR_AND_SSIM) -> dict[str, Any]:
        """Metrics by split and scale, by what the photographs' sizes are divided, with the keys of metrics.json."""
        metrics: dict[str, Any] = {"test": {}, "train": {}}
        for scale in scales:
            scene = self.photographs.downscaled(scale)
            photographs = Photographs(self.device, self.background)
            for split in ("test", "train"):
                if scene.split(split):
                    results = measure(self.rasterizer, self.model, scene.split(split), photographs, perceptual)
                    metrics[split][f"{scale:g}"] = mean(results, perceptual)
        return {**metrics, "gaussians": self.model.gaussians.count, "device": self.device.text}
