"""The sky of a model: whether there is one, what it begins with, its Adam, its losses, its tables in a checkpoint."""

import logging
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import ConfigError, DataError
from clsplat.core.schedule import at_step
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.gaussians.model import Model
from clsplat.gaussians.sky import SIDES, DeviceSky, Sky
from clsplat.losses.base import LossValue
from clsplat.photos.photographs import apply_mask
from clsplat.photos.sky_detection import SkyEvidence, looked_at, panorama
from clsplat.render.backdrops import Auto, Backdrop, Directions
from clsplat.render.filters import ModelSettings
from clsplat.scene.quality import is_transparent
from clsplat.scene.scene import Scene
from clsplat.training.modules.base import ModuleState, Numbers, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")
SKY: Literal["sky"] = "sky"  # the type of the module
TEXELS, MOMENTS, BIASES, FREE = "texels", ("moment1", "moment2"), "biases", "free"
WIDTHS = {TEXELS: 3, **dict.fromkeys(MOMENTS, 3), BIASES: 2, FREE: 1}


class SkyModule(TrainingModule):
    """The sky of a model.  The model brings it: no list names it."""

    brought_as: ClassVar[str] = SKY
    measure: ClassVar[str | None] = SKY
    place: ClassVar[int] = -20
    outlasts: ClassVar[Literal["acts"]] = "acts"

    @classmethod
    def brought(cls, run: Run, stage: Any) -> "SkyModule | None":
        has_sky = SKY in run.modules if run.has_model else _in_use(run.model_settings.background)
        return cls(type=SKY) if has_sky else None

    @classmethod
    def measured(cls, run: Run) -> float | None:
        """Return the share of the training photographs that show a sky; None where that is not known.

        Views for validation count as training views.
        """
        if _unknown(run):
            return None
        background = run.model_settings.background
        number, count = _counted(run, (background if isinstance(background, Auto) else Auto()).share)
        return number / count

    @classmethod
    def settled_model(cls, run: Run, settings: ModelSettings, modules: Sequence[TrainingModule]) -> ModelSettings:
        """Return the settings with the choice of a sky, where it is open: none where a module does not go with it.

        Raises ConfigError where one does not go with a sky that is chosen.
        """
        background = settings.background
        rival = next((one for one in modules if SKY in one.conflicts and one.is_active(run.scene)), None)
        against = rival and f"'{rival.type}' does not go together with sky: {rival.conflicts[SKY]}"
        if against and _in_use(background):
            raise ConfigError(f"model.background: {against}; leave one of them out")
        if not isinstance(background, Auto) or background.chosen is not None:
            return settings
        chosen, reason = ("off", against) if against else _choice(background, run)
        LOG.info("model.background: %s, since %s", chosen, reason)
        return settings.model_copy(
            update={"background": background.model_copy(update={"chosen": chosen, "reason": reason})}
        )

    @classmethod
    def begin_model(cls, run: Run, source: Model | None) -> None:
        """Give the run's new model its first sky, where it is to have one: that of the source, or, without it and at
        another size of the map, the colors of the sky that the photographs show."""
        own, settings = source and source.sky, cls.settled_model(run, run.model_settings, ())
        if (background := _in_use(settings.background)) is None:
            run.modules.pop(SKY, None)
            if own:
                LOG.warning("the sky of the model is left out; model.background: directions keeps it")
            return
        if is_transparent(run.scene):
            LOG.warning(
                "model.background: the photographs have transparency: what is learned and exported as a sky is the "
                "color that clsplat puts behind them; leave model.background out"
            )
        texels, free = _first(run, background.side)
        sky = own if own and own.side == background.side else Sky(texels)
        run.modules[SKY] = LearnedSky(background, sky.upload(run.device), free)
        LOG.info("sky: %d of %d x %d colors by direction are learned", free.sum(), background.side, background.side)

    @classmethod
    def advice(cls, run: Run) -> Iterator[str]:
        """What a sky means that was chosen by the photographs."""
        background = run.model_settings.background
        if isinstance(background, Auto) and background.in_use is not None:
            why, _, _ = background.reason.partition(";")
            yield f"a sky was added, since {why}; other viewers show it where `export` has `sky: splats`"

    def state(self, run: Run) -> "LearnedSky":
        """Return that of the run, or one to load: an init stage begins it."""
        background = _in_use(run.model_settings.background)
        assert background
        blank = Sky(np.zeros((background.side**2, 3), np.float32))
        return run.modules.get(SKY) or LearnedSky(background, blank.upload(run.device))

    @classmethod
    def check_saved(cls, numbers: Numbers, tables: Tables) -> None:
        super().check_saved(numbers, tables)
        if tables.keys() not in (WIDTHS.keys(), {TEXELS}):
            raise DataError("it has another sky than one of its own tables")
        texels = len(tables[TEXELS])
        side = int(np.sqrt(texels))
        for name, table in tables.items():
            if side * side != texels or not SIDES[0] <= side <= SIDES[1] or table.shape != (texels, WIDTHS[name]):
                raise DataError(f"{name} of its sky is not [side * side, {WIDTHS[name]}]")


def _in_use(background: Backdrop | None) -> Directions | None:
    """The sky that settings ask for, once it is chosen."""
    given = background.in_use if isinstance(background, Auto) else background
    return given if isinstance(given, Directions) else None


# What photographs show of a sky.


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
    """The first colors of the map and which are learned; all, from the mean of the upper thirds of photographs, where
    none shows a sky."""
    seen = _seen(run, run.scene)
    if found := panorama(seen, side):
        return found
    uppers = [one.upper.mean(axis=0) / 255 for one in seen if len(one.upper)]
    if not uppers:
        LOG.warning("masks leave out the upper thirds of all photographs: the sky begins black")
    mean = np.mean(uppers, axis=0) if uppers else np.zeros(3)
    return np.tile(mean, (side**2, 1)).astype(np.float32), np.ones(side**2, bool)


def _seen(run: Run, scene: Scene) -> list[SkyEvidence]:
    """What each training photograph of a scene, at the first size that it has, shows of the sky."""
    views = list({view.name: view for view in reversed(scene.split("train"))}.values())[::-1]
    counted = run.status.counted(views, "photographs", len(views))
    photographs = ((view, run.photographs.get(view)) for view in counted)
    return list(looked_at(scene, ((view, one.image(), one.counted()) for view, one in photographs)))


# The sky in a training.


class LearnedSky(ModuleState):
    """The sky of a model, with Adam's moments, the bias of each texel's updates, and which texels are learned."""

    def __init__(self, settings: Directions, sky: DeviceSky, free: NDArray[np.bool_] | None = None) -> None:
        """The sky is changed in place by each update.  free: the texels that are learned, [side * side]; None: all."""
        super().__init__()
        self.settings, self.sky, self.outlasts = settings, sky, "acts"
        zeros, texels = sky.texels.device.zeros, sky.side**2
        self._arrays = {name: zeros((width, texels)) for name, width in WIDTHS.items() if name != TEXELS}
        chosen = np.ones(texels, bool) if free is None else free
        self._arrays[FREE].set(chosen[None].astype(np.float32))

    def complete(self, model: DeviceModel) -> None:
        model.sky = self.sky

    def load(self, numbers: Numbers, tables: Tables) -> None:
        self.sky.texels.set(np.ascontiguousarray(tables[TEXELS].T))
        for name, array in self._arrays.items():
            array.set(np.ascontiguousarray(tables[name].T))

    def tables(self, whole: bool = True) -> Tables:
        """Copy its tables to the host, each [side * side, components]."""
        arrays = {TEXELS: self.sky.texels, **self._arrays}
        return {name: np.ascontiguousarray(array.get().T) for name, array in arrays.items()}

    def before_losses(self, step: TrainingStep) -> None:
        """Add the loss of what covers the sky, where it has a weight."""
        camera, comparison = step.camera, step.comparison
        if not (weight := at_step(self.settings.cover, step.number)):
            return
        scale = weight / (camera.width * camera.height)
        difference = at_step(self.settings.difference, step.number)
        step.behind, sums = step.rasterizer.skies.cover(
            self.sky, self._arrays[FREE], camera, comparison.photograph, step.frame.transmittance, difference, scale
        )
        if comparison.mask is not None:
            apply_mask(step.workspace, camera, step.behind, comparison.mask)
        value = LossValue(SKY, lambda: scale * float(np.asarray(sums.get()).sum(dtype=np.float64)))
        step.own_losses.append(value)

    def backward(self, step: TrainingStep) -> None:
        """By the texels that the view shows, [3, shown], from the gradient by its image."""
        frame = step.frame
        step.keep(self, step.rasterizer.skies.by_texels(self.sky, frame.camera, frame.transmittance, step.gradient))

    def update(self, step: TrainingStep) -> None:
        """Change the texels that a view shows by Adam."""
        rate = at_step(self.settings.rate, step.number)
        step.rasterizer.skies.update(self.sky, step.frame.camera, step.kept(self), self._arrays, rate)
