"""What photographs have for themselves in a run: where a training begins."""

from clsplat.render.rasterizer import Rasterizer
from clsplat.training.own_gaussians import OwnGaussians, PhotographDistractors, first_tables
from clsplat.training.run import Run
from clsplat.views.distractors import Distractors


def photograph_distractors(settings: Distractors | None, run: Run) -> PhotographDistractors | None:
    """Return the distractors of a training, or None where it has none; a resumed run has its Gaussians."""
    if settings is None:
        run.distractors = None
        return None
    views = run.scene.split("train")
    if run.distractors is None:
        photographs = list({view.name: view for view in reversed(views)}.values())[::-1]
        counted = run.status.counted(photographs, "photographs", len(photographs))
        pixels = [(view, run.photographs.get(view).image()) for view in counted]
        run.distractors = OwnGaussians(run.device, first_tables(settings.count, pixels))
    sort, budget = run.rasterizer.tiler.sort, run.rasterizer.budget
    own = Rasterizer(run.device, "radix" if sort == "auto" else sort, budget)
    return PhotographDistractors(settings, views, own, run.distractors)
