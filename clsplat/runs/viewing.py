"""Models, of files or run folders, on one page to walk through."""

import logging
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import ConfigError
from clsplat.gaussians.model import Model, load
from clsplat.gaussians.sky_splats import with_sky_splats
from clsplat.names import PIPELINE
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.progress import counted
from clsplat.results import check_no_file_of_a_run
from clsplat.runs.source import Source, require_model, run_of
from clsplat.scene.photographs import load_photograph
from clsplat.scene.scene import View
from clsplat.scene.stand import Stand
from clsplat.viewer.packing import pack
from clsplat.viewer.page import Page, is_viewer
from clsplat.viewer.photographs import BUDGET, Which, described
from clsplat.views.photographs import BACKGROUNDS

LOG = logging.getLogger("clsplat")
MOST = 2  # models beside each other
MANY = 2_000_000  # splats: a page of more opens slowly


def view(
    models: Sequence[Path],
    scene: Path | None = None,
    out: Path = Path("viewer.html"),
    *,
    photographs: Which = "test",
    photograph_budget: float = BUDGET,
    splats: int | None = None,
) -> Path:
    """Write a page that shows one model, or two with one camera; return the page.  Raises ClsplatError.

    scene: whose views and photographs are in the page; by default that of the first run folder among the models.
    """
    if not 1 <= len(models) <= MOST:
        raise ConfigError(f"view: expected one model or two, got {len(models)}")
    if out.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{out}: expected a name that ends in .html, as browsers open it")
    if not (out.is_file() and is_viewer(out)):
        check_no_file_of_a_run(out)
    if splats is not None and splats < 1:
        raise ConfigError(f"--splats {splats}: expected a number of at least 1")
    if photographs not in ("none", "test", "all"):
        raise ConfigError(f"no photographs '{photographs}'; there are none, test and all")
    if not 0 <= photograph_budget < math.inf:
        raise ConfigError(f"--photograph-budget {photograph_budget:g}: expected MB, a finite number of at least 0")
    for path in models:
        require_model(path)
    source = next((Source.of(path, scene) for path in models if scene is not None or run_of(path)), None)
    if photographs == "all" and source is None:
        raise ConfigError("--photographs all needs the photographs of a scene; give --scene, or a run folder")
    _tell_of_scenes(models, source)
    called = names(models)
    loaded = dict(zip(called, map(load, counted(models, "models read", len(models))), strict=True))
    _advise(loaded, splats)
    first = next(iter(loaded.values()))
    found = source.scene(first).downscaled(source.settings.downscale) if source else None
    background = first.rendering.background or (found.background if found else "black")

    def read(one: View) -> NDArray[np.uint8]:
        return load_photograph(one, BACKGROUNDS[background])[:, :, :3]

    views = described(found, read, photographs, photograph_budget) if found else []
    start = (found.split("test") or found.views)[0] if found else None
    stand = Stand.of(first.means, found.views if found else (), start)
    title = " and ".join(loaded) + (f" · {source.scene_name}" if source else "")
    if found is None:
        LOG.info("without a scene up is -y; give --scene where the picture stands on its head")
    packed = counted(loaded.items(), "models packed", len(loaded))
    shown = {name: pack(with_sky_splats(model), splats) for name, model in packed}
    Page(title, shown, stand, background, views).write(out)
    return out


def _advise(loaded: Mapping[str, Model], splats: int | None) -> None:
    """Warn of models with more splats than a page shows smoothly, before they are packed, which takes minutes."""
    for name, model in loaded.items():
        if min(len(model), splats or len(model)) > MANY:
            LOG.warning(
                "%s: has %s splats; they take a while to pack, and browsers show %s smoothly: --splats %d keeps the "
                "most important",
                *(name, f"{len(model):,}", f"{MANY:,}", MANY),
            )


def _tell_of_scenes(models: Sequence[Path], source: Source | None) -> None:
    """Warn where models are of different scenes: the page has the cameras of one."""
    scenes = {}
    for name, run in zip(names(models), map(run_of, models), strict=True):
        with suppress(ConfigError):  # of a plug-in that is missing: the model can be shown
            if run and (path := load_pipeline(str(run / PIPELINE)).settings.scene.path):
                scenes[name] = Path(path).resolve()
    if source and len(set(scenes.values())) > 1:
        told = [part for one in scenes.items() for part in one]
        LOG.warning("%s is of %s, %s of %s: both stand before the cameras of %s", *told, source.scene_name)


def names(models: Sequence[Path]) -> list[str]:
    """Return a name for each model: its folder's or file's, with more of the path where two are the same."""
    short = [path.resolve().name if path.is_dir() else path.stem for path in models]
    parents = [path.resolve().parent.name for path in models]
    if len(set(short)) < len(short):
        short = [f"{parent}/{name}" for parent, name in zip(parents, short, strict=True)]
    return short if len(set(short)) == len(short) else [f"{name} ({i})" for i, name in enumerate(short, 1)]
