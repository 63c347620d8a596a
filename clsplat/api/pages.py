"""Pages of runs and models as functions; errors as in `clsplat.api.commands`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from clsplat.api.arguments import PathLike, load_plugins, path_of


def compare_runs(runs: Sequence[PathLike], out: PathLike = "compare.html", published: PathLike | None = None) -> int:
    """Write the page that shows runs side by side; return their number.  The folder of a matrix stands for its runs.

    published: a YAML file of figures that others have published, which are shown below, apart.
    """
    from clsplat.compare.page import write_comparison
    from clsplat.compare.published import read_published
    from clsplat.results import check_result

    check_result(Path(out), ".html")
    tables = [] if published is None else read_published(Path(published))
    return write_comparison([Path(folder) for folder in runs], Path(out), published=tables)


def view(
    *models: PathLike,
    scene: PathLike | None = None,
    out: PathLike = "viewer.html",
    photographs: Literal["none", "test", "all"] = "test",
    photograph_budget: float = 4.0,
    splats: int | None = None,
) -> Path:
    """Write a page that shows one model, or two with one camera, in any browser and offline; return the page.

    models: files or run folders; scene: whose views and photographs are in the page, by default that of a run folder;
    photographs: of which views, up to `photograph_budget` MB; splats: only so many, the most important ones.
    """
    from clsplat.runs import viewing

    load_plugins()
    return viewing.view(
        [Path(model) for model in models],
        path_of(scene),
        Path(out),
        photographs=photographs,
        photograph_budget=photograph_budget,
        splats=splats,
    )
