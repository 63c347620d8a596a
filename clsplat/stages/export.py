"""The model as a file."""

import logging
from typing import ClassVar, Literal

import numpy as np

from clsplat import __version__
from clsplat.gaussians.ply import Parameters, read_ply, write_ply
from clsplat.gaussians.tables import PARAMETERS
from clsplat.stages.base import Scheduled
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
MIN_LOGIT = -80.0  # of an opacity that the filter reduces to zero: the smallest logit of the kernels


class Export(Scheduled):
    """Write a PLY in the reference's layout and read it back.

    A world filter is applied to scales and opacities, so that any viewer can show the file.  A second file, with `_raw`
    in its name, holds the model as trained, with the filter as a property `filter_3D`.
    """

    stage: Literal["export"] = "export"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    file: str = "point_cloud.ply"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        gaussians = run.model.gaussians
        path = run.out / self.file
        parameters = {name: gaussians.get(name) for name in (*PARAMETERS, "filter_variance")}
        files = {path: baked(parameters)}
        if parameters["filter_variance"].any():
            files[path.with_name(f"{path.stem}_raw{path.suffix}")] = parameters
        for file, tables in files.items():
            write_ply(file, tables, {"version": __version__, **run.rendering()})
            read_ply(file)
            LOG.info("%d Gaussians written to %s", gaussians.count, file)


def baked(parameters: Parameters) -> Parameters:
    """Return the Gaussians with the world filter applied to scales and opacities (Yu et al. 2024, eq. 9)."""
    tables = {name: parameters[name] for name in PARAMETERS}
    variance = parameters["filter_variance"].astype(np.float64)
    if variance.any():
        scale2 = np.exp(2 * parameters["log_scales"].astype(np.float64))
        filtered2 = scale2 + variance
        opacity = np.sqrt(np.prod(scale2 / filtered2, axis=1, keepdims=True))
        opacity /= 1 + np.exp(-parameters["logit_opacity"].astype(np.float64))
        with np.errstate(divide="ignore"):
            logit = np.log(opacity) - np.log1p(-opacity)
        tables["log_scales"] = (0.5 * np.log(filtered2)).astype(np.float32)
        tables["logit_opacity"] = np.maximum(logit, MIN_LOGIT).astype(np.float32)
    return tables
