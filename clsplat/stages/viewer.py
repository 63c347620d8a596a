"""The model as a page to walk through."""

import logging
from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from clsplat.gaussians.sky_splats import with_sky_splats
from clsplat.pages.page import require_end
from clsplat.scene.scene import View
from clsplat.scene.stand import Stand
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.host_model import host_model
from clsplat.training.poses import refined
from clsplat.training.run import Run
from clsplat.viewer.packing import pack
from clsplat.viewer.page import MAX_SIZE, Page
from clsplat.viewer.photographs import BUDGET, Which, described

LOG = logging.getLogger("clsplat")


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
        scene, name = refined(run.numbers, run.original).downscaled(run.downscale), run.photographs.background_name

        def read(view: View) -> NDArray[np.uint8]:
            return run.photographs.get(view).image()

        def through(views: Iterable[View]) -> Iterable[View]:
            return run.status.counted(run.until_interrupted(views), "views", len(scene.views))

        views = described(scene, read, self.photographs, self.photograph_budget, through)
        stand = Stand.of(model.means, scene.views, (scene.split("test") or scene.views)[0])
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

    def verify(self, run: Run) -> None:
        require_end(run.out / self.file)
