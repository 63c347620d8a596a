"""The model as a file."""

import logging
from typing import Annotated, ClassVar, Literal

from clsplat.gaussians.model import load
from clsplat.stages.base import Scheduled, path_in_run
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Export(Scheduled):
    """Write a PLY in the reference's layout and read it back.

    A world filter is applied to scales and opacities, so that any viewer can show the file.  A second file, with `_raw`
    in its name, holds the model as trained, with the filter as a property `filter_3D`.
    """

    stage: Literal["export"] = "export"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    file: Annotated[str, path_in_run(".ply")] = "point_cloud.ply"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        model = run.host_model()
        path = run.out / self.file
        files = {path: model.baked()}
        if model.filter_variance is not None:
            files[path.with_name(f"{path.stem}_raw{path.suffix}")] = model
        for file, one in files.items():
            one.save(file)
            load(file)
            LOG.info("%d Gaussians written to %s", len(one), file)
