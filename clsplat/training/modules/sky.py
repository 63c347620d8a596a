"""Train the sky of a model: its loss, its Adam updates, and its tables in checkpoints."""

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.core.schedule import at_step
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.gaussians.sky import SIDES, DeviceSky, Sky
from clsplat.losses.base import LossValue
from clsplat.photos.photographs import apply_mask
from clsplat.render.backdrops import EnvironmentMap
from clsplat.training.modules.base import ModuleState, Scalars, Tables, TrainingModule, TrainingStep
from clsplat.training.run import Run

SKY: Literal["sky"] = "sky"  # the type of the module
TEXELS, MOMENTS, BIASES, FREE = "texels", ("moment1", "moment2"), "biases", "free"
WIDTHS = {TEXELS: 3, **dict.fromkeys(MOMENTS, 3), BIASES: 2, FREE: 1}


class SkyModule(TrainingModule):
    """The sky of a model, implied by `model.background`."""

    implicit_type: ClassVar[str] = SKY
    order: ClassVar[int] = -20

    @classmethod
    def implied_module(cls, run: Run, stage: Any) -> "SkyModule | None":
        has_sky = SKY in run.modules if run.has_model else run.model_settings.sky
        return cls(type=SKY) if has_sky else None

    def create_state(self, run: Run) -> "LearnedSky":
        """Return the sky that the init stage created, or a black sky into which a saved state is loaded."""
        settings = run.model_settings.sky
        assert settings
        black_sky = Sky(np.zeros((settings.side**2, 3), np.float32))
        return run.modules.get(SKY) or LearnedSky(settings, black_sky.upload(run.device))

    @classmethod
    def check_saved(cls, scalars: Scalars, tables: Tables) -> None:
        super().check_saved(scalars, tables)
        if tables.keys() not in (WIDTHS.keys(), {TEXELS}):
            raise DataError(f"its sky has tables {', '.join(tables)}; expected {', '.join(WIDTHS)}")
        texels = len(tables[TEXELS])
        side = int(np.sqrt(texels))
        for name, table in tables.items():
            if side * side != texels or not SIDES[0] <= side <= SIDES[1] or table.shape != (texels, WIDTHS[name]):
                raise DataError(f"{name} of its sky does not have the shape [side * side, {WIDTHS[name]}]")


class LearnedSky(ModuleState):
    """The sky of a model, with Adam moments, their bias corrections per texel, and a mask of the learned texels."""

    after_training: ClassVar[Literal["dropped", "kept", "active"]] = "active"

    def __init__(self, settings: EnvironmentMap, sky: DeviceSky, free: NDArray[np.bool_] | None = None) -> None:
        """sky: changed in place by updates; free: mask of the learned texels, [side * side], or None for all."""
        super().__init__()
        self.settings, self.sky = settings, sky
        zeros, texels = sky.texels.device.zeros, sky.side**2
        self._arrays = {name: zeros((width, texels)) for name, width in WIDTHS.items() if name != TEXELS}
        mask = np.ones(texels, bool) if free is None else free
        self._arrays[FREE].set(mask[None].astype(np.float32))

    def attach_to(self, model: DeviceModel) -> None:
        model.sky = self.sky

    def load(self, scalars: Scalars, tables: Tables) -> None:
        self.sky.texels.set(np.ascontiguousarray(tables[TEXELS].T))
        for name, array in self._arrays.items():
            array.set(np.ascontiguousarray(tables[name].T))

    def tables(self, full: bool = True) -> Tables:
        """Copy the tables to the host, each [side * side, components]."""
        arrays = {TEXELS: self.sky.texels, **self._arrays}
        return {name: np.ascontiguousarray(array.get().T) for name, array in arrays.items()}

    def before_losses(self, step: TrainingStep) -> None:
        """Add the loss on Gaussians that cover the sky."""
        camera, comparison = step.camera, step.comparison
        if not (weight := at_step(self.settings.cover, step.number)):
            return
        scale = weight / (camera.width * camera.height)
        difference = at_step(self.settings.difference, step.number)
        step.transmittance_gradient, sums = step.rasterizer.skies.coverage_loss(
            self.sky, self._arrays[FREE], camera, comparison.photograph, step.frame.transmittance, difference, scale
        )
        if comparison.mask is not None:
            apply_mask(step.workspace, camera, step.transmittance_gradient, comparison.mask)
        value = LossValue(SKY, lambda: scale * float(np.asarray(sums.get()).sum(dtype=np.float64)))
        step.module_losses.append(value)

    def backward(self, step: TrainingStep) -> None:
        """Compute the gradient of the texels that are visible in the view, [3, texels in the view]."""
        frame = step.frame
        step.save(self, step.rasterizer.skies.grad_texels(self.sky, frame.camera, frame.transmittance, step.gradient))

    def update(self, step: TrainingStep) -> None:
        """Update the texels that are visible in the view, with Adam."""
        rate = at_step(self.settings.rate, step.number)
        step.rasterizer.skies.update(self.sky, step.frame.camera, step.saved_value(self), self._arrays, rate)
