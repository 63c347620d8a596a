"""What a model shows: the views of a split as image files, and a page to walk through."""

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import pluralize
from clsplat.gaussians.conversion import with_sky_splats
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.scene.images import is_image, write_image
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.training.modules.base import learned_scene
from clsplat.training.run import Run, host_model
from clsplat.training.stage import Stage, path_in_run
from clsplat.viewer.packing import pack
from clsplat.viewer.page import BUDGET, MAX_SIZE, Page, Which, described

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
        views = learned_scene(run).downscaled(run.downscale).split(self.split)
        return dict(zip(image_paths(run.out / self.folder, [view.name for view in views]), views, strict=True))

    def run(self, run: Run) -> None:
        views = self._views(run)
        counted = run.status.counted(run.until_interrupted(views.items()), "views", len(views))
        for path, view in counted:
            camera = upload_camera(run.device, view)
            write_image(path, render_view(run.painter(), camera))
        if views:
            LOG.info("%s written to %s", pluralize(len(views), "image"), run.out / self.folder)


def image_paths(folder: Path, views: Sequence[str], suffix: str = ".png") -> list[Path]:
    """Return the files of views' renders; where two views differ in the suffix alone, it stays in their names."""
    paths = [image_path(folder, view, suffix) for view in views]
    uses = Counter(paths)
    return [path if uses[path] == 1 else folder / f"{view}{suffix}" for path, view in zip(paths, views, strict=True)]


def image_path(folder: Path, view: str, suffix: str = ".png") -> Path:
    """Return the file of a view's render: the view's name below `folder`, with another suffix."""
    name = PurePosixPath(view)
    return folder / name.with_suffix(suffix) if is_image(name) else folder / f"{view}{suffix}"


# The model as a page to walk through.


class Viewer(Stage):
    """Write a page that shows the model from every side, and beside its photographs; it opens offline in any browser.

    Where it would have more than 200 MB, it has the most important Gaussians that fit, and a warning says so.
    """

    stage: Literal["viewer"] = "viewer"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    file: Annotated[str, path_in_run(".html")] = "viewer.html"
    """Path inside the run folder."""
    photographs: Which = "test"
    """Views whose photographs are in the page; all views have a thumbnail."""
    photograph_budget: Annotated[float, Field(gt=0, le=MAX_SIZE)] = BUDGET
    """MB of photographs; with more, every second, third, … is in the page."""

    def run(self, run: Run) -> None:
        path, model = run.out / self.file, host_model(run)
        shown = with_sky_splats(model)
        scene, name = learned_scene(run).downscaled(run.downscale), run.photographs.background_name

        def read(view: View) -> NDArray[np.uint8]:
            return run.photographs.get(view).image()

        def through(views: Iterable[View]) -> Iterable[View]:
            return run.status.counted(run.until_interrupted(views), "views", len(scene.views))

        views = described(scene, read, self.photographs, self.photograph_budget, through)
        stand = Viewpoint.from_points(model.means, scene.views, (scene.split("test") or scene.views)[0])
        page = Page(f"{run.name} · {run.scene_name}", {run.name: pack(shown)}, stand, name, views)
        if page.size > MAX_SIZE and page.fitting:  # else the photographs are the fault, which the page says
            LOG.warning(
                "%s: shows the %s most important of %s Gaussians, so that browsers can open it; "
                "`clsplat compress` makes models of fewer",
                *(path, f"{page.fitting:,}", f"{len(shown):,}"),
            )
            page = Page(page.title, {run.name: pack(shown, page.fitting)}, stand, name, views)
        page.write(path)
        LOG.info("viewer written to %s, %.1f MB", path, path.stat().st_size / 1e6)
