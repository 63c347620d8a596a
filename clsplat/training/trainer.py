"""Run one training step: render a view, compare it with its photograph, differentiate, update, count statistics."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from clsplat.core.schedule import Schedule, at_step
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
    require_loss_value,
    required_content,
)
from clsplat.losses.image import add_losses
from clsplat.opencl.device import Array, constants
from clsplat.photos.photographs import Photograph, apply_mask, unmasked_gradient
from clsplat.photos.transforms import PhotographTransform
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import VIEWS, Adam, Rates, Rows, add_gradients, attach_gradients
from clsplat.training.modules.base import ModuleState, TrainingStep

TEXTURE = int(constants("splat.h")["SUM_TEXTURE"])


@dataclass
class StepTrainer:
    """The objects of a training step; pipelines, benchmarks, and notebooks call the same `step`.

    A custom loop over the training views of a scene that trains a model loaded with `clsplat.load`:

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

    Between steps, Gaussians may be changed (`model.gaussians.set`) or rearranged (`clsplat.density.edit`).  A loop with
    its own optimizer calls `differentiate`, the step without Adam, or its two parts, `compare` and `backward`.
    """

    rasterizer: Rasterizer
    model: DeviceModel
    adam: Adam
    stats: SplatStats
    background: Array  # [3] in [0, 1]
    losses: Sequence[Loss]
    rates: Rates
    extent: float = 1.0  # scene units
    rows: Rows = "all"  # Gaussians that a step updates
    views_per_update: Schedule = 1  # views whose mean gradient an Adam update uses
    modules: Sequence[ModuleState] = ()  # forward in this order, backward in reverse

    def step(
        self,
        photograph: Photograph,
        step: int,
        transforms: Sequence[PhotographTransform] = (),
        frozen: Collection[str] = (),
    ) -> ViewGradients:
        """Train on one view at a global step.  frozen: parameters that are not updated.

        Returns the losses and the gradients, which are valid until the next step.
        """
        while not self.update(gradients := self.start(photograph, step, transforms), frozen):
            pass
        return gradients

    def differentiate(
        self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()
    ) -> ViewGradients:
        """Return the losses of one view and their gradient, summed over the pixels of each splat, without an update.

        Raises ConfigError like `compare`.
        """
        return self.backward(self.compare(photograph, step, transforms))

    def compare(self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()) -> ViewLosses:
        """Render one view and compare it with its photograph, without an update.

        Raises ConfigError for a loss that is neither an ImageLoss nor a Penalty, and for a loss that a module does not
        support.
        """
        while not (losses := self._compare(photograph, step, transforms)).step.is_complete:
            pass
        return losses

    def start(self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()) -> ViewGradients:
        """Differentiate like `differentiate`, without waiting: if `update` returns False, repeat both."""
        return self.backward(self._compare(photograph, step, transforms))

    def _compare(self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform]) -> ViewLosses:
        content = required_content(self.losses, step)
        workspace, timings = self.rasterizer.workspace, self.rasterizer.device.timings
        data = TrainingStep(step, self.rasterizer, photograph, self.model, self.background, self.losses, transforms)
        data.modules = self.modules
        for module in data.modules:
            module.before_render(data)
        camera = data.camera
        data.frame = self.rasterizer.start_forward(data.model, camera, data.background, content)
        data.frames.append((self.rasterizer, data.frame))
        timings.section = "loss"
        backgrounds = self.background, data.background
        data.planes = data.photograph.planes(workspace, transforms, step, backgrounds)
        data.image, data.gradient = data.frame.image, workspace.array("grad_image", data.frame.image.shape)
        for module in data.modules:
            module.after_render(data)
        target, mask = data.planes.colors, data.planes.mask
        data.comparison = comparison = Comparison(workspace, camera, data.image, target, data.gradient, mask, step)
        if content != "color":  # color losses overwrite only the first three planes
            data.gradient.fill(0)
            comparison.accumulate = True
        if mask is not None:  # masked pixels are black in both images and have no gradient
            apply_mask(workspace, camera, data.image, mask)
            apply_mask(workspace, camera, target, mask)
        for module in data.modules:
            module.before_losses(data)
        image_losses = [loss for loss in self.losses if isinstance(loss, ImageLoss)]
        if any(loss.runs_on_host for loss in image_losses) and not data.is_complete:
            return self._compare(photograph, step, transforms)
        data.losses += add_losses(image_losses, comparison)
        data.losses += data.module_losses
        return ViewLosses(data.frame, comparison, data.losses, step=data)

    def backward(self, losses: ViewLosses) -> ViewGradients:
        """Differentiate losses of `compare`; return them and the gradient, summed over the pixels of each splat."""
        data, workspace, sum_count = losses.step, self.rasterizer.workspace, self.stats.pixel_sums
        mask = data.planes.mask
        if mask is not None:
            apply_mask(workspace, data.camera, data.gradient, mask)
        for module in reversed(data.modules):
            module.backward(data)
        self.rasterizer.device.timings.section = "statistics"
        texture = unmasked_gradient(workspace, data.camera, data.planes.colors, mask) if sum_count > TEXTURE else None
        data.sums = self.rasterizer.backward(
            data.model, data.frame, data.gradient, sum_count, texture, data.transmittance_gradient
        )
        for module in reversed(data.modules):
            module.after_backward(data)
        return ViewGradients(data.frame, data.comparison, data.losses, data.sums, step=data)

    def update(self, gradients: ViewGradients, frozen: Collection[str] = ()) -> bool:
        """Update the parameters, Adam's moments, the statistics, and the modules with the result of `start`.

        Returns False, without any change, if a frame had no room for its pairs.  Waits only for the number of pairs.
        """
        data, counts = gradients.step, dict(self.adam.updates)
        # without room, the fused kernel does nothing; it knows only the frame of the model, and no deferred updates
        is_guarded = self._is_fused(data, frozen) and len(data.frames) == 1
        is_guarded = is_guarded and self.adam.effective_rows(self.rows) != "deferred"
        if not (is_guarded or data.is_complete):
            return False
        grad_mean2d, has_statistics = self._update_parameters(gradients, frozen)
        if is_guarded and not data.is_complete:
            self.adam.updates.update(counts)
            return False
        for module in reversed(data.modules):  # in the order in which the device finished their gradients
            module.update(data)
        self.rasterizer.device.timings.section = "statistics"
        self.stats.add(gradients, grad_mean2d, has_statistics)
        return True

    def _is_fused(self, data: TrainingStep, frozen: Collection[str]) -> bool:
        """Return whether one kernel computes the gradients and updates the parameters with them."""
        has_penalty = any(isinstance(loss, Penalty) for loss in self.losses)
        has_motion_or_depth = self.model.gaussians.is_moving or data.frame.content == "inverse_depth"
        return not (has_penalty or frozen or has_motion_or_depth or self.views_per_update != 1)

    def _update_parameters(self, view_gradients: ViewGradients, frozen: Collection[str]) -> tuple[Array, bool]:
        """Update the parameters and add the penalties to the view's losses.

        Returns the gradient of the projected means, [2, S] px⁻¹, and whether statistics were added.  A fused kernel
        updates the parameters and adds statistics without writing gradients to memory, unless the training uses
        penalties, frozen parameters, motion, depths, or several views per update.
        """
        gaussians, step = self.model.gaussians, view_gradients.comparison.step
        rates = self.rates.at(step, self.extent)
        if self._is_fused(view_gradients.step, frozen):
            sums_pairs = self.stats.is_in_update and self.rasterizer.device.schedule != "wide"  # slower on CPUs
            sums = view_gradients.sums if sums_pairs else view_gradients.pixel_sums
            inputs = self.model, view_gradients.frame, sums, rates, self.rows
            return self.adam.update(*inputs, self.stats.update_arguments()), True
        gradients = self.rasterizer.gradients(self.model, view_gradients.frame, view_gradients.pixel_sums)
        is_deferred = self.rows == "deferred" or gaussians.on_host
        penalty_gradients = gradients.without_deferred() if is_deferred else gradients
        penalty_inputs = PenaltyInputs(self.rasterizer.workspace, gaussians, penalty_gradients, self.extent, step)
        self.rasterizer.device.timings.section = "loss"
        penalties = [loss for loss in self.losses if isinstance(loss, Penalty)]
        view_gradients.losses.extend(require_loss_value(penalty, penalty.add(penalty_inputs)) for penalty in penalties)
        if self.views_per_update != 1:
            attach_gradients(gaussians)
            gradients = add_gradients(gaussians, gradients)
            if step % int(at_step(self.views_per_update, step)):
                return gradients.mean2d, False
            gaussians[VIEWS].fill(0)
        self.adam.step(self.model, view_gradients.frame, gradients, rates, frozen, self.rows)
        return gradients.mean2d, False
