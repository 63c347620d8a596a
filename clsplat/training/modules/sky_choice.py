"""Decide from the photographs whether a model has a sky, and initialize the sky."""

import logging
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError
from clsplat.gaussians.model import Model
from clsplat.gaussians.sky import Sky
from clsplat.photos.sky_detection import SkyEvidence, build_sky_map, detect_sky
from clsplat.render.backdrops import Auto
from clsplat.render.filters import ModelSettings
from clsplat.scene.quality import is_transparent
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import TrainingModule
from clsplat.training.modules.sky import SKY, LearnedSky
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


def choose_sky(run: Run, settings: ModelSettings, modules: Sequence[TrainingModule]) -> ModelSettings:
    """Return model settings with `background: auto` resolved; if a module conflicts with a sky, `auto` adds none.

    Raises ConfigError if a module conflicts with a sky that the settings require.
    """
    background = settings.background
    module = next((module for module in modules if SKY in module.conflicts and module.is_active(run.scene)), None)
    conflict = module and f"'{module.type}' cannot be combined with sky: {module.conflicts[SKY]}"
    if conflict and settings.sky:
        raise ConfigError(f"model.background: {conflict}; remove one of them")
    if not isinstance(background, Auto) or background.chosen is not None:
        return settings
    choice, reason = ("off", conflict) if conflict else _choose(background, run)
    LOG.log(logging.INFO if choice == "on" else logging.DEBUG, "model.background: %s, since %s", choice, reason)
    new_background = background.model_copy(update={"chosen": choice, "reason": reason})
    return settings.model_copy(update={"background": new_background})


def start_sky(run: Run, source: Model | None) -> None:
    """Initialize the sky of the run's new model, if it has one, from `source` or from the photographs.

    source: the model from which the new model was created, or None.
    """
    initial, background = source and source.sky, choose_sky(run, run.model_settings, ()).sky
    if background is None:
        run.modules.pop(SKY, None)
        if initial:
            LOG.warning("the sky of the model is dropped; set model.background: envmap to keep it")
        return
    if is_transparent(run.scene):
        LOG.warning(
            "model.background: the photos have transparent pixels, so the sky would learn the color that clsplat "
            "puts behind them; remove model.background"
        )
    texels, free = _first_texels(run, background.side)
    sky = initial if initial and initial.side == background.side else Sky(texels)
    run.modules[SKY] = LearnedSky(background, sky.upload(run.device), free)
    LOG.info("sky: optimizing %d of its %d x %d texels", free.sum(), background.side, background.side)


def sky_reason(run: Run) -> str:
    """Return the reason why `auto` added a sky to a run; empty if `auto` did not add one."""
    background = run.model_settings.background
    if not isinstance(background, Auto) or background.sky is None:
        return ""
    return background.reason.partition(";")[0]


def _explain_unknown(run: Run) -> str:
    """Return the reason why a sky cannot be detected in the photographs; empty if it can be detected."""
    if run.scene.points is None:
        return "the dataset has no points to tell distant regions from near ones"
    return "the photos have transparency" if is_transparent(run.scene) else ""


def _count_skies(run: Run, min_fraction: float) -> tuple[int, int]:
    """Count the photographs with at least `min_fraction` of sky in their upper third, and all photographs."""
    evidence = _detect_skies(run, run.scene.merge_validation())
    return sum(photo.sky_fraction >= min_fraction for photo in evidence), len(evidence)


def _choose(background: Auto, run: Run) -> tuple[Literal["on", "off"], str]:
    """Decide whether the model has a sky, and return the decision and its reason."""
    if reason := _explain_unknown(run):
        return "off", reason
    sky_count, count = _count_skies(run, background.share)
    is_sky = sky_count >= background.photographs * count
    text = (
        f"{sky_count} of {count} photos show bright or blue regions above the horizon, without points, in "
        f"{background.share:.0%} or more of their upper third; a sky needs {background.photographs:.0%} of the photos"
    )
    return ("on" if is_sky else "off"), text


def _first_texels(run: Run, side: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the initial colors of the sky, [side * side, 3], and the mask of the learned texels, [side * side].

    If no photograph shows a sky, all texels are learned, starting from the mean color of the photographs' upper thirds.
    """
    evidence = _detect_skies(run, run.scene)
    if texels := build_sky_map(evidence, side):
        return texels
    upper_colors = [photo.upper_pixels.mean(axis=0) / 255 for photo in evidence if len(photo.upper_pixels)]
    if not upper_colors:
        LOG.warning("masks exclude the upper thirds of all photos, so the sky starts black")
    mean = np.mean(upper_colors, axis=0) if upper_colors else np.zeros(3)
    return np.tile(mean, (side**2, 1)).astype(np.float32), np.ones(side**2, bool)


def _detect_skies(run: Run, scene: Scene) -> list[SkyEvidence]:
    """Detect the sky in each training photograph of a scene, at the first of its sizes."""
    views = list({view.name: view for view in reversed(scene.split("train"))}.values())[::-1]
    progress = run.status.counted(views, "photos", len(views))
    photographs = ((view, run.photographs.get(view)) for view in progress)
    return list(detect_sky(scene, ((view, photo.image(), photo.unmasked_pixels()) for view, photo in photographs)))
