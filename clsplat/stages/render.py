"""Render a split to image files."""

import logging
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Literal

from clsplat.errors import DataError, amount
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.scene.images import image_size, is_image, write_image
from clsplat.scene.view import View
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.poses import refined
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class Render(Stage):
    """Write one PNG for each view of a split, with the name of the view."""

    stage: Literal["render"] = "render"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"split", "folder"})

    split: Literal["test", "train", "all"] = "test"
    """Views that are rendered."""
    folder: Annotated[str, path_in_run()] = "renders"
    """Path inside the run folder."""

    def _views(self, run: Run) -> dict[Path, View]:
        """The views of the split, by the file of their render."""
        views = refined(run.numbers, run.original).downscaled(run.downscale).split(self.split)
        return dict(zip(image_paths(run.out / self.folder, [view.name for view in views]), views, strict=True))

    def run(self, run: Run) -> None:
        views = self._views(run)
        counted = run.status.counted(run.until_interrupted(views.items()), "views", len(views))
        for path, view in counted:
            camera = upload_camera(run.device, view)
            write_image(path, render_view(run.painter(), camera))
        if views:
            LOG.info("%s written to %s", amount(len(views), "image"), run.out / self.folder)

    def verify(self, run: Run) -> None:
        for path, view in self._views(run).items():
            if image_size(path) != (view.camera.width, view.camera.height):
                raise DataError(f"{path}: has another size than its view")


def image_paths(folder: Path, views: Sequence[str], suffix: str = ".png") -> list[Path]:
    """Return the files of views' renders; where two views differ in the suffix alone, it stays in their names."""
    paths = [image_path(folder, view, suffix) for view in views]
    uses = Counter(paths)
    return [path if uses[path] == 1 else folder / f"{view}{suffix}" for path, view in zip(paths, views, strict=True)]


def image_path(folder: Path, view: str, suffix: str = ".png") -> Path:
    """Return the file of a view's render: the view's name below `folder`, with another suffix."""
    name = PurePosixPath(view)
    return folder / name.with_suffix(suffix) if is_image(name) else folder / f"{view}{suffix}"
