"""Run one training step: render a view, compare it with its photograph, differentiate, update, count statistics."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from clsplat.density.statistics import SplatStats
from clsplat.gaussians.gaussians import DeviceModel
from clsplat.losses.base import (
    Comparison,
    ImageLoss,
    Loss,
    Penalty,
    PenaltyInputs,
    ViewGradients,
    ViewLosses,
    required_content,
    returned,
)
from clsplat.opencl.device import Array, constants
from clsplat.photos.photographs import Photograph, apply_mask, known_gradient
from clsplat.photos.transforms import PhotographTransform
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates, Rows
from clsplat.training.modules.base import ModuleState, TrainingStep

TEXTURE = int(constants("splat.h")["SUM_TEXTURE"])


@dataclass
class StepTrainer:
    """The objects of a training step; pipelines, benchmarks and notebooks call the same `step`.

    A custom loop over the training views of a scene, from a model of `clsplat.load`:

        model = model.upload(device)
        photographs = Photographs(device, scene.background)
        trainer = StepTrainer(
            Rasterizer(device),
            model,
            Adam(model.gaussians),
            SplatStats(model.gaussians, []),
            photographs.background,
            losses=[L1(weight=0.8), Dssim(weight=0.2)],
            rates=Rates(),
            extent=scene.extent,
        )
        for step, view in enumerate(scene.split("train"), 1):
            gradients = trainer.step(photographs.get(view), step)
            print(gradients.loss)

    Between two steps the Gaussians may be changed (`model.gaussians.set`) or moved (`clsplat.density.edit`).  A loop
    with its own optimizer calls `differentiate`, the step without Adam, or its two parts, `compare` and `backward`.
    """

    rasterizer: Rasterizer
    model: DeviceModel
    adam: Adam
    stats: SplatStats
    background: Array  # [3] in [0, 1]
    losses: Sequence[Loss]
    rates: Rates
    extent: float = 1.0  # scene units
    rows: Rows = "all"  # Gaussians that a step changes
    modules: Sequence[ModuleState] = ()  # forward in this order, backward in reverse

    def step(
        self,
        photograph: Photograph,
        step: int,
        transforms: Sequence[PhotographTransform] = (),
        stale: Collection[str] = (),
    ) -> ViewLosses:
        """Train on one view at a global step.  stale: parameters that are not updated.

        Returns the losses and, unless a module skips the step, the gradients; valid until the next step.
        """
        view = self.differentiate(photograph, step, transforms)
        self.update(view, stale)
        return view

    def differentiate(
        self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()
    ) -> ViewLosses:
        """Return the gradient of the losses at one view, as sums over pixels, without an update.

        Raises ConfigError like `compare`.
        """
        view = self.compare(photograph, step, transforms)
        return view if view.step.skipped else self.backward(view)

    def compare(self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()) -> ViewLosses:
        """Render one view and compare it with its photograph, without an update.

        Raises ConfigError for a loss that is neither an ImageLoss nor a Penalty, for two that read different fourth
        planes, and for one that a module does not support.
        """
        content = required_content(self.losses, step)
        workspace, timings = self.rasterizer.workspace, self.rasterizer.device.timings
        now = TrainingStep(step, self.rasterizer, photograph, self.model, self.background, self.losses, transforms)
        now.modules = self.modules
        for module in now.modules:
            module.before_render(now)
        camera = now.camera
        now.frame = self.rasterizer.forward(now.model, camera, now.background, content)
        timings.section = "loss"
        backgrounds = self.background, now.background
        now.planes = now.photograph.planes(workspace, transforms, step, backgrounds)
        now.image, now.gradient = now.frame.image, workspace.array("grad_image", now.frame.image.shape)
        for module in now.modules:
            module.after_render(now)
        target, mask = now.planes.colors, now.planes.mask
        now.comparison = comparison = Comparison(workspace, camera, now.image, target, now.gradient, mask, step)
        if content != "color":  # color losses overwrite only the first three planes
            now.gradient.fill(0)
            comparison.accumulate = True
        if mask is not None:  # pixels that do not count are black in both images and have no gradient
            apply_mask(workspace, camera, now.image, mask)
            apply_mask(workspace, camera, target, mask)
        for module in now.modules:
            module.before_losses(now)
        now.losses += [returned(loss, loss.add(comparison)) for loss in self.losses if isinstance(loss, ImageLoss)]
        now.losses += now.module_losses
        for module in now.modules:
            module.after_losses(now)
        return ViewLosses(now.frame, comparison, now.losses, step=now)

    def backward(self, view: ViewLosses) -> ViewGradients:
        """Return the gradient of the losses from `compare`, as sums over pixels."""
        now, workspace, count = view.step, self.rasterizer.workspace, self.stats.pixel_sums
        mask = now.planes.mask
        if mask is not None:
            apply_mask(workspace, now.camera, now.gradient, mask)
        for module in reversed(now.modules):
            module.backward(now)
        self.rasterizer.device.timings.section = "statistics"
        texture = known_gradient(workspace, now.camera, now.planes.colors, mask) if count > TEXTURE else None
        now.pixel_sums = self.rasterizer.pixel_sums(
            now.model, now.frame, now.gradient, count, texture, now.transmittance_gradient
        )
        for module in reversed(now.modules):
            module.after_backward(now)
        return ViewGradients(now.frame, now.comparison, now.losses, now.pixel_sums, step=now)

    def update(self, view: ViewLosses, stale: Collection[str] = ()) -> None:
        """Apply the result of `differentiate`: update parameters, moments, statistics and modules."""
        if not isinstance(view, ViewGradients):
            for module in view.step.modules:
                module.update_skipped(view.step)
            return
        grad_mean2d = self._update(view, stale)
        for module in reversed(view.step.modules):  # first wait for what the device finished first
            module.update(view.step)
        self.rasterizer.device.timings.section = "statistics"
        self.stats.add(view, grad_mean2d)

    def _update(self, view: ViewGradients, stale: Collection[str]) -> Array:
        """Update the parameters and add the penalties to the view's losses.

        Returns the gradient of the projected means, [2, S] px⁻¹.  Without penalties, stale parameters, motion
        and depths, a fused kernel never writes gradients to memory.
        """
        penalties = [loss for loss in self.losses if isinstance(loss, Penalty)]
        step = view.comparison.step
        rates = self.rates.at(step, self.extent)
        if not (penalties or stale or self.model.gaussians.is_moving or view.frame.content == "inverse_depth"):
            return self.adam.update(self.model, view.frame, view.pixel_sums, rates, self.rows)
        gradients = self.rasterizer.gradients(self.model, view.frame, view.pixel_sums)
        waits = self.rows == "deferred" or self.model.gaussians.on_host
        current = gradients.without_deferred() if waits else gradients
        inputs = PenaltyInputs(self.rasterizer.workspace, self.model.gaussians, current, self.extent, step)
        self.rasterizer.device.timings.section = "loss"
        view.losses.extend(returned(penalty, penalty.add(inputs)) for penalty in penalties)
        self.adam.step(self.model, view.frame, gradients, rates, stale, self.rows)
        return gradients.mean2d
