"""Models measured at the views of a scene, as they come from training and from files."""

import logging

from clsplat.gaussians.model import Model
from clsplat.metrics.views import mean, measure
from clsplat.render.painter import Splats
from clsplat.render.rasterizer import Rasterizer
from clsplat.runs.model_file import ModelFile
from clsplat.scene.decoding import decode_all, require_whole
from clsplat.scene.identity import Identity
from clsplat.views.photographs import Photographs

LOG = logging.getLogger("clsplat")


class Measurer:
    """Measures models at the test views of a scene; at its training views where it has no others."""

    def __init__(self, opened: ModelFile) -> None:
        self.opened = opened
        self.split = "test" if opened.scene.split("test") else "train"
        if self.split == "train":
            LOG.warning(
                "%s: has no test views; the training views are measured; scene.holdout keeps some for it",
                opened.scene.path,
            )
        self.rasterizer = Rasterizer(opened.device)
        self.photographs = Photographs(opened.device, opened.background)

    def identity(self) -> str:
        """Return a hash of the photographs, cameras and points.  Raises DataError where a photograph is damaged."""
        scene = self.opened.scene
        files = decode_all(scene.views)
        require_whole(scene.path, files)
        return Identity.of(scene, files).digest

    def figures(self, model: Model) -> tuple[float, float]:
        """Return PSNR, dB, and SSIM."""
        views = self.opened.scene.split(self.split)
        painter = Splats(self.rasterizer, model.upload(self.opened.device), self.photographs.background)
        results = measure(painter, views, self.photographs)
        averages = mean(results)
        return averages["psnr"], averages["ssim"]
