"""The cameras beside the model, for other programs."""

import logging
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from clsplat.cameras.table import PLACES, checked, write_cameras
from clsplat.errors import DataError
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.poses import refined
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Cameras(Stage):
    """Write the cameras of the scene, at the photographs' full size, so that a model travels with its views.

    After a training with `poses` they are the learned ones, with the learned focal lengths; see `optimize.poses`."""

    stage: Literal["cameras"] = "cameras"
    output_keys: ClassVar[frozenset[str]] = frozenset({"formats", "folder"})

    formats: Annotated[list[Literal["colmap", "nerfstudio", "inria"]], Field(min_length=1)] = Field(["inria"])
    """Files that are written: a COLMAP model as text, transforms.json, cameras.json."""
    folder: Annotated[str, path_in_run()] = "cameras"
    """Path inside the run folder."""

    def check_in(self, run: Run) -> None:
        for name in self.formats:
            checked(run.original, name)

    def run(self, run: Run) -> None:
        for name in self.formats:
            for path in write_cameras(refined(run.numbers, run.original), run.out / self.folder, name, over=True):
                LOG.info("cameras written to %s", path)

    def verify(self, run: Run) -> None:
        for name in self.formats:
            if not (path := run.out / self.folder / PLACES[name][0]).is_file():
                raise DataError(f"{path}: is missing")
