"""Render a split to image files."""

import logging
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Literal

from clsplat.metrics.views import render_view
from clsplat.scene.images import is_image, write_image
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Render(Stage):
    """Write one PNG for each view of a split, with the name of the view."""

    stage: Literal["render"] = "render"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    split: Literal["test", "train", "all"] = "test"
    """Views that are rendered."""
    folder: Annotated[str, path_in_run()] = "renders"
    """Path inside the run folder."""

    def run(self, run: Run) -> None:
        views = run.scene.downscaled(run.downscale).split(self.split)
        for view in views:
            camera = run.photographs.camera(view)
            image = render_view(run.rasterizer, run.model, camera, run.photographs.background)
            write_image(image_path(run.out / self.folder, view.name), image)
        LOG.info("%d images written to %s", len(views), run.out / self.folder)


def image_path(folder: Path, view: str, suffix: str = ".png") -> Path:
    """Return the file of a view's render: the view's name below `folder`, with another suffix."""
    name = PurePosixPath(view)
    return folder / name.with_suffix(suffix) if is_image(name) else folder / f"{view}{suffix}"
