"""The sky of a run: whether there is one, and what it begins with."""

import logging
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.gaussians.sky import Sky
from clsplat.render.backdrops import Auto, Backdrop, Directions
from clsplat.scene.scene import Scene, View
from clsplat.scene.transparency import is_transparent
from clsplat.training.run import Run
from clsplat.training.sky import LearnedSky
from clsplat.views.sky_share import Seen, looked_at, panorama

LOG = logging.getLogger("clsplat")


def begin_sky(run: Run, own: Sky | None = None) -> None:
    """Give the run's new model its first sky, where it is to have one.

    own: what a model had that is trained further; without it, or at another size of the map, the colours of the sky
    that the photographs show.
    """
    settings = settled(run.model_settings.background, run)
    background = settings.in_use if isinstance(settings, Auto) else settings
    if not isinstance(background, Directions):
        run.sky = None
        if own:
            LOG.warning("the sky of the model is left out; model.background: directions keeps it")
        return
    if is_transparent(run.scene):
        LOG.warning(
            "model.background: the photographs have transparency: what is learned and exported as a sky is the colour "
            "that clsplat puts behind them; leave model.background out"
        )
    texels, free = _first(run, background.side)
    sky = own if own and own.side == background.side else Sky(texels)
    run.sky = LearnedSky(background, sky.upload(run.device), free)
    LOG.info("sky: %d of %d x %d colours by direction are learned", free.sum(), background.side, background.side)


def will_learn_sky(run: Run) -> bool:
    """Whether the model of a run has a sky, once its choices are made."""
    background = run.model_settings.background
    return isinstance(background.in_use if isinstance(background, Auto) else background, Directions)


def settled(background: Backdrop | None, run: Run) -> Backdrop | None:
    """Return what is behind the Gaussians, with the choice that follows from a run's photographs; one that is made
    stays."""
    if not isinstance(background, Auto) or background.chosen is not None:
        return background
    chosen, reason = _choice(background, run)
    LOG.info("model.background: %s, since %s", chosen, reason)
    return background.model_copy(update={"chosen": chosen, "reason": reason})


def share_with_sky(run: Run) -> float | None:
    """Return the share of the training photographs that show a sky; None where that is not known.

    Views for validation count as training views.
    """
    if _unknown(run):
        return None
    background = run.model_settings.background
    number, count = _counted(run, (background if isinstance(background, Auto) else Auto()).share)
    return number / count


def _unknown(run: Run) -> str:
    """Why photographs do not tell whether they show a sky; empty where they do."""
    if run.scene.points is None:
        return "the dataset has no points, and what is far from them is not known"
    return "the photographs have transparency" if is_transparent(run.scene) else ""


def _counted(run: Run, share: float) -> tuple[int, int]:
    """How many training photographs show the sky in such a share of their upper third, or more, and how many there are.

    Views for validation count as training views.
    """
    seen = _seen(run, run.scene.with_fold())
    return sum(one.share >= share for one in seen), len(seen)


def _choice(background: Auto, run: Run) -> tuple[Literal["on", "off"], str]:
    """Whether there is a sky, and why."""
    if why := _unknown(run):
        return "off", why
    number, count = _counted(run, background.share)
    text = (
        f"{number} of {count} photographs show bright or blue regions above the horizon, without points, in "
        f"{background.share:.0%} or more of their upper third"
    )
    enough = number >= background.photographs * count
    return ("on" if enough else "off"), f"{text}; {'' if enough else 'not '}{background.photographs:.0%} of them"


def _first(run: Run, side: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """The first colours of the map and which are learned; all, from the mean of the upper thirds of photographs, where
    none shows a sky."""
    seen = _seen(run, run.scene)
    if found := panorama(seen, side):
        return found
    uppers = [one.upper.mean(axis=0) / 255 for one in seen if len(one.upper)]
    if not uppers:
        LOG.warning("masks leave out the upper thirds of all photographs: the sky begins black")
    mean = np.mean(uppers, axis=0) if uppers else np.zeros(3)
    return np.tile(mean, (side**2, 1)).astype(np.float32), np.ones(side**2, bool)


def _seen(run: Run, scene: Scene) -> list[Seen]:
    """What each training photograph of a scene shows of the sky."""
    return list(looked_at(scene, _photographs(run, scene)))


def _photographs(run: Run, scene: Scene) -> Iterator[tuple[View, NDArray[np.uint8], NDArray[np.bool_] | None]]:
    """The training photographs of a scene at the first size that they have, [height, width, 3], and which pixels
    count, [height, width]; None: all."""
    views = list({view.name: view for view in reversed(scene.split("train"))}.values())[::-1]
    for view in run.status.counted(views, "photographs", len(views)):
        photograph = run.photographs.get(view)
        yield view, photograph.image(), photograph.counted()
