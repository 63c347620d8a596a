"""The model as a file."""

import logging
from typing import ClassVar, Literal

from clsplat import __version__
from clsplat.gaussians.model import PARAMETERS
from clsplat.gaussians.ply import read_ply, write_ply
from clsplat.stages.base import Stage
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Export(Stage):
    """Write a PLY in the reference's layout and read it back."""

    stage: Literal["export"] = "export"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    file: str = "point_cloud.ply"  # inside the run folder

    def run(self, run: Run) -> None:
        gaussians = run.trained.gaussians
        path = run.out / self.file
        write_ply(path, {name: gaussians.get(name) for name in PARAMETERS}, {"version": __version__, **run.rendering()})
        read_ply(path)
        LOG.info("%d Gaussians written to %s", gaussians.count, path)
