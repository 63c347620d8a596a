"""The sky while a model is trained: its Adam, its losses, and its tables in a checkpoint."""

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.schedule import at_step
from clsplat.gaussians.sky import SIDES, DeviceSky, Sky
from clsplat.losses.base import Comparison, LossValue
from clsplat.opencl.device import Array
from clsplat.photos.photographs import apply_mask
from clsplat.render.backdrops import Auto, Directions
from clsplat.render.rasterizer import Frame, Rasterizer
from clsplat.training.modules.base import ModuleState, Numbers, Tables, TrainingModule, TrainingStep
from clsplat.training.run import SKY, Run

TEXELS, MOMENTS, BIASES, FREE = "texels", ("moment1", "moment2"), "biases", "free"
WIDTHS = {TEXELS: 3, **dict.fromkeys(MOMENTS, 3), BIASES: 2, FREE: 1}


class SkyModule(TrainingModule):
    """The sky of a model.  The model brings it: no list names it."""

    brought_as: ClassVar[str] = SKY
    place: ClassVar[int] = -20
    outlasts: ClassVar[Literal["acts"]] = "acts"

    @classmethod
    def brought(cls, run: Run, stage: Any) -> "SkyModule | None":
        return cls(type=SKY) if run.sky else None

    @classmethod
    def saved(cls, run: Run) -> "SkyModule | None":
        return cls(type=SKY) if _background(run) else None

    def state(self, run: Run) -> "LearnedSky":
        """Return that of the run, or one to load: an init stage begins it."""
        background = _background(run)
        assert background
        blank = Sky(np.zeros((background.side**2, 3), np.float32))
        return run.sky or LearnedSky(background, blank.upload(run.device))

    @classmethod
    def check_saved(cls, numbers: Numbers, tables: Tables) -> None:
        check_tables(tables)


def _background(run: Run) -> Directions | None:
    """The sky that the model of a run has; one that is not chosen yet counts."""
    given = run.model_settings.background
    if isinstance(given, Auto):
        given = None if given.chosen == "off" else given.model
    return given if isinstance(given, Directions) else None


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

    def load(self, numbers: Numbers, tables: Tables) -> None:
        self.sky.texels.set(np.ascontiguousarray(tables[TEXELS].T))
        for name, array in self._arrays.items():
            array.set(np.ascontiguousarray(tables[name].T))

    def tables(self, whole: bool = True) -> Tables:
        """Copy its tables to the host, each [side * side, components]."""
        arrays = {TEXELS: self.sky.texels, **self._arrays}
        return {name: np.ascontiguousarray(array.get().T) for name, array in arrays.items()}

    def cover(self, rasterizer: Rasterizer, frame: Frame, comparison: Comparison) -> tuple[Array, LossValue] | None:
        """Return T dL/dT of the loss of what covers the sky, [1, rows, stride], and its value; None where it has no
        weight."""
        camera, step = comparison.camera, comparison.step
        weight = at_step(self.settings.cover, step)
        if not weight:
            return None
        scale, difference = weight / (camera.width * camera.height), at_step(self.settings.difference, step)
        behind, sums = rasterizer.skies.cover(
            self.sky, self._arrays[FREE], camera, comparison.photograph, frame.transmittance, difference, scale
        )
        if comparison.mask is not None:
            apply_mask(rasterizer.workspace, camera, behind, comparison.mask)
        return behind, LossValue("sky", lambda: scale * float(np.asarray(sums.get()).sum(dtype=np.float64)))

    def by_texels(self, rasterizer: Rasterizer, frame: Frame, gradient: Array) -> Array:
        """Return derivatives by the texels that a view shows, [3, shown], from those by its image."""
        return rasterizer.skies.by_texels(self.sky, frame.camera, frame.transmittance, gradient)

    def before_losses(self, step: TrainingStep) -> None:
        if cover := self.cover(step.rasterizer, step.frame, step.comparison):
            step.behind, value = cover
            step.own_losses.append(value)

    def backward(self, step: TrainingStep) -> None:
        step.keep(self, self.by_texels(step.rasterizer, step.frame, step.gradient))

    def update(self, step: TrainingStep) -> None:
        """Change the texels that a view shows by Adam."""
        rate = at_step(self.settings.rate, step.number)
        step.rasterizer.skies.update(self.sky, step.frame.camera, step.kept(self), self._arrays, rate)


def check_tables(tables: Tables) -> None:
    """Raise DataError for tables that are not those of a sky."""
    if tables.keys() not in (WIDTHS.keys(), {TEXELS}):
        raise DataError("it has another sky than one of its own tables")
    texels = len(tables[TEXELS])
    side = int(np.sqrt(texels))
    for name, table in tables.items():
        if side * side != texels or not SIDES[0] <= side <= SIDES[1] or table.shape != (texels, WIDTHS[name]):
            raise DataError(f"{name} of its sky is not [side * side, {WIDTHS[name]}]")
        if not np.isfinite(table).all():
            raise DataError(f"{name} of its sky holds values that are not finite")
