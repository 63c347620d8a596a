"""Render the views of a split to image files, and write a page to walk through the model."""

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.core.errors import pluralize
from clsplat.metrics.views import render_view
from clsplat.render.camera import upload_camera
from clsplat.scene.images import is_image, write_image
from clsplat.scene.view import View
from clsplat.scene.viewpoint import Viewpoint
from clsplat.training.modules.base import learned_scene
from clsplat.training.run import Run, host_model, sky_center
from clsplat.training.stage import Stage, path_in_run
from clsplat.viewer.packing import pack
from clsplat.viewer.page import BUDGET, MAX_SIZE, IncludedPhotos, Page, view_entries

LOG = logging.getLogger("clsplat")


class Render(Stage):
    """Write a PNG for each view of a split, named after the view."""

    stage: Literal["render"] = "render"
    needs: ClassVar[frozenset[str]] = frozenset({"painter"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"split", "folder"})

    split: Literal["test", "train", "all"] = "test"
    """Views to render."""
    folder: Annotated[str, path_in_run()] = "renders"
    """Path inside the run folder."""

    def _views(self, run: Run) -> dict[Path, View]:
        """Return the views of the split by the path of their render."""
        views = learned_scene(run).downscaled(run.downscale).split(self.split)
        return dict(zip(image_paths(run.out / self.folder, [view.name for view in views]), views, strict=True))

    def run(self, run: Run) -> None:
        views = self._views(run)
        progress = run.status.counted(run.until_interrupted(views.items()), "views", len(views))
        for path, view in progress:
            camera = upload_camera(run.device, view)
            write_image(path, render_view(run.painter(), camera))
        if views:
            LOG.debug("%s written to %s", pluralize(len(views), "image"), run.out / self.folder)


def image_paths(folder: Path, views: Sequence[str], suffix: str = ".png") -> list[Path]:
    """Return the paths of the renders of views.  Views whose names differ only in the suffix keep their suffix."""
    paths = [image_path(folder, view, suffix) for view in views]
    counts = Counter(paths)
    return [path if counts[path] == 1 else folder / f"{view}{suffix}" for path, view in zip(paths, views, strict=True)]


def image_path(folder: Path, view: str, suffix: str = ".png") -> Path:
    """Return the path of a view's render: the view's name below `folder`, with another suffix."""
    name = PurePosixPath(view)
    return folder / name.with_suffix(suffix) if is_image(name) else folder / f"{view}{suffix}"


class Viewer(Stage):
    """Write a page that shows the model from any viewpoint, next to its photos; the page opens offline in any browser.

    If the page would exceed 200 MB, it shows only the most important Gaussians, with a warning.
    """

    stage: Literal["viewer"] = "viewer"
    needs: ClassVar[frozenset[str]] = frozenset({"model"})

    file: Annotated[str, path_in_run(".html")] = "viewer.html"
    """Path inside the run folder."""
    photographs: IncludedPhotos = "test"
    """Views whose photos are in the page; all views have a thumbnail."""
    photograph_budget: Annotated[float, Field(gt=0, le=MAX_SIZE)] = BUDGET
    """Maximum total size of the photos in MB; if they are larger, only every second, third, … photo is in the page."""

    def run(self, run: Run) -> None:
        path, model = run.out / self.file, host_model(run)
        scene, color = learned_scene(run).downscaled(run.downscale), run.photographs.background_name

        def read(view: View) -> NDArray[np.uint8]:
            return run.photographs.get(view).image()

        def with_progress(views: Iterable[View]) -> Iterable[View]:
            return run.status.counted(run.until_interrupted(views), "views", len(scene.views))

        views = view_entries(scene, read, self.photographs, self.photograph_budget, with_progress)
        viewpoint = Viewpoint.from_points(model.means, scene.views, (scene.split("test") or scene.views)[0])
        packed_model = pack(model, None, sky_center(run))
        page = Page(f"{run.name} · {run.scene_name}", {run.name: packed_model}, viewpoint, color, views, scene.origin)
        if page.size > MAX_SIZE and (max_count := page.max_splats):  # 0: `write` reports that the photos are too large
            LOG.warning(
                "%s: shows only the %s most important splats of %s, so that browsers can open it; "
                "`clsplat compress` makes smaller models",
                *(path, f"{max_count:,}", packed_model.count_text),
            )
            page = Page(
                page.title, {run.name: pack(model, max_count, sky_center(run))}, viewpoint, color, views, scene.origin
            )
        page.write(path)
        LOG.debug("viewer written to %s, %.1f MB", path, path.stat().st_size / 1e6)
