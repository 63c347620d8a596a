"""One training step: render a view, compare it with its photograph, differentiate, update, count."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

from clsplat.core.schedule import Schedule, at_step
from clsplat.density.statistics import SplatStats
from clsplat.gaussians.gaussians import DeviceModel, Dropout
from clsplat.losses.base import (
    Comparison,
    ImageLoss,
    Loss,
    LossValue,
    Penalty,
    PenaltyInputs,
    ViewGradients,
    ViewLosses,
    content_of,
    gradient_by_photograph,
    require_symmetric,
    returned,
)
from clsplat.opencl.device import Array, constants
from clsplat.photos.appearance import ViewColours
from clsplat.photos.depths import PointDepths
from clsplat.photos.photographs import Photograph, apply_mask, known_gradient
from clsplat.photos.transforms import LearnedTransform, PhotographTransform, Planes, learned_of, name_of
from clsplat.render.camera import DeviceCamera
from clsplat.render.rasterizer import Rasterizer
from clsplat.training.adam import Adam, Rates, Rows
from clsplat.training.modules.camera_optimizer import PhotographPoses
from clsplat.training.modules.distractors import PhotographDistractors
from clsplat.training.modules.random_background import Backgrounds
from clsplat.training.modules.sky import LearnedSky
from clsplat.training.modules.transients import Transients, without_transients

TEXTURE = int(constants("splat.h")["SUM_TEXTURE"])


@dataclass
class Trainer:
    """The objects of a training step; pipelines, benchmarks and notebooks call the same `step`.

    A loop of one's own, on the training views of a scene, from a model of `clsplat.load`:

        model = model.upload(device)
        photographs = Photographs(device, scene.background)
        trainer = Trainer(
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

    Between two steps the Gaussians may be changed (`model.gaussians.set`) or moved (`clsplat.density.edit`).  In a loop
    that applies its own update, `differentiate` is the step without Adam; `compare` and `backward` are its two parts.
    """

    rasterizer: Rasterizer
    model: DeviceModel
    adam: Adam
    stats: SplatStats
    background: Array  # [3] in [0, 1]
    losses: Sequence[Loss]
    rates: Rates
    extent: float = 1.0  # scene units
    numbers: dict[str, float] = field(default_factory=dict)  # of a transform that learns, by name; a step changes them
    rows: Rows = "all"  # Gaussians that a step changes
    colours: ViewColours | None = None  # of the photographs, where they have colours of their own
    transients: Transients | None = None  # which pixels are left out; None: none
    sky: LearnedSky | None = None  # of the model, where it has one
    dropout: Schedule = 0.0  # probability with which a step leaves a Gaussian out, by step
    seed: int = 0  # of what is drawn
    poses: PhotographPoses | None = None  # of the cameras, where they are learned
    backgrounds: Backgrounds | None = None  # by step, in the place of `background`
    depths: PointDepths | None = None  # that are known, where a loss reads them
    distractors: PhotographDistractors | None = None  # of the photographs, where they have Gaussians of their own

    def step(
        self,
        photograph: Photograph,
        step: int,
        transforms: Sequence[PhotographTransform] = (),
        stale: Collection[str] = (),
    ) -> ViewGradients:
        """Train on one view at a global step; parameters named in `stale` are not updated.

        Returns the view's losses and gradients, which are valid until the next step.
        """
        view = self.differentiate(photograph, step, transforms)
        self.update(view, stale)
        return view

    def differentiate(
        self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()
    ) -> ViewGradients:
        """Return the derivative of the losses at one view, as sums over pixels; nothing is updated.

        Raises ConfigError as `compare` does.
        """
        return self.backward(self.compare(photograph, step, transforms))

    def compare(self, photograph: Photograph, step: int, transforms: Sequence[PhotographTransform] = ()) -> ViewLosses:
        """Render one view and compare it with its photograph; nothing is updated.

        Raises ConfigError for a loss that is neither an ImageLoss nor a Penalty, for two that read different fourth
        planes, and, where a transform learns, for one that is not symmetric in image and photograph.
        """
        content = content_of(self.losses, step)
        require_symmetric(self.losses, transforms)
        photograph = self.poses.place(photograph, self.numbers, step) if self.poses else photograph
        workspace, camera, timings = self.rasterizer.workspace, photograph.camera, self.rasterizer.device.timings
        background = self.backgrounds.at(step) if self.backgrounds else self.background
        frame = self.rasterizer.forward(self._drawn(step), camera, background, content)
        timings.section = "loss"
        planes = photograph.planes(workspace, transforms, step, self.numbers, (self.background, background))
        gradient = workspace.array("grad_image", frame.image.shape)
        layer = self.distractors.before(self.model, camera, frame.image, step) if self.distractors else None
        image, own = self._coloured(camera, layer.image if layer else frame.image)
        own += [LossValue("distractors", layer.loss)] if layer else []
        learning: list[Callable[[], None]] = []
        if self.transients:
            planes, learning = without_transients(self.transients, planes, image, self.numbers, step)
        comparison = Comparison(workspace, camera, image, planes.colours, gradient, planes.mask, step)
        comparison.depths = self.depths.at(camera) if self.depths else None
        if content != "colour":  # losses of colours overwrite three planes alone
            gradient.fill(0)
            comparison.accumulate = True
        if planes.mask is not None:  # pixels that do not count are black in both images and have no gradient
            apply_mask(workspace, camera, image, planes.mask)
            apply_mask(workspace, camera, planes.colours, planes.mask)
        learned = learned_of(transforms)
        of_transform, learn = self._learn(learned, planes, comparison) if learned else ([], [])
        values = [returned(loss, loss.add(comparison)) for loss in self.losses if isinstance(loss, ImageLoss)]
        behind = None
        if self.sky and (cover := self.sky.cover(self.rasterizer, frame, comparison)):
            behind, value = cover
            own.append(value)
        losses = [*values, *of_transform, *own]
        return ViewLosses(frame, comparison, losses, learning=[*learning, *learn], behind=behind, layer=layer)

    def backward(self, view: ViewLosses) -> ViewGradients:
        """Return the derivative of the losses that `compare` returned, as sums over pixels."""
        comparison, workspace, camera = view.comparison, self.rasterizer.workspace, view.comparison.camera
        photograph, gradient, mask = comparison.photograph, comparison.gradient, comparison.mask
        if mask is not None:
            apply_mask(workspace, camera, gradient, mask)
        gradient, learning = self._uncoloured(view, gradient)
        if self.distractors and view.layer and comparison.camera.view is not None:
            learning = [self.distractors.learning(view.layer, gradient, comparison.camera.view), *learning]
        learning = [*self._of_sky(view, gradient), *learning]
        count = self.stats.pixel_sums
        self.rasterizer.device.timings.section = "statistics"
        texture = known_gradient(workspace, camera, photograph, mask) if count > TEXTURE else None
        model = self._drawn(comparison.step)
        pixel_sums = self.rasterizer.pixel_sums(model, view.frame, gradient, count, texture, view.behind)
        if self.poses and (learn := self.poses.learning(workspace, model, view.frame, pixel_sums, comparison.step)):
            learning.append(lambda: learn(self.numbers))
        return ViewGradients(view.frame, comparison, view.losses, pixel_sums, learning=learning)

    def _drawn(self, step: int) -> DeviceModel:
        """The model as a step draws it."""
        probability = at_step(self.dropout, step)
        return replace(self.model, dropout=Dropout(probability, self.seed, step)) if probability else self.model

    def _coloured(self, camera: DeviceCamera, image: Array) -> tuple[Array, list[LossValue]]:
        """The image in the colours of its photograph, where that has its own, and the loss of their numbers."""
        if self.colours is None or camera.view is None:
            return image, []
        changed, penalty = self.colours.change(self.rasterizer.workspace, camera, image, self.numbers, camera.view)
        return changed, [LossValue("colours", penalty)]

    def _uncoloured(self, view: ViewLosses, gradient: Array) -> tuple[Array, Sequence[Callable[[], None]]]:
        """The gradient by the image as it was rendered, and what changes the numbers of transforms and photographs."""
        colours, comparison, learning = self.colours, view.comparison, view.learning
        camera, number = comparison.camera, comparison.camera.view
        if colours is None or number is None:
            return gradient, learning
        workspace, numbers = self.rasterizer.workspace, self.numbers
        gradient, learn = colours.change_back(
            workspace, camera, view.rendered, gradient, numbers, number, comparison.step
        )
        return gradient, [*learning, learn]

    def _of_sky(self, view: ViewLosses, gradient: Array) -> list[Callable[[], None]]:
        """What changes the sky after the Gaussians.  gradient: by the image as it was rendered."""
        if (sky := self.sky) is None:
            return []
        by_texels = sky.by_texels(self.rasterizer, view.frame, gradient)
        return [lambda: sky.update(self.rasterizer, view.frame, by_texels, view.comparison.step)]

    def _learn(
        self, transform: LearnedTransform, planes: Planes, comparison: Comparison
    ) -> tuple[list[LossValue], list[Callable[[], None]]]:
        """Begin the derivatives by the transform's numbers; return its own loss, and what changes the numbers.

        The host waits for them after all of the step is enqueued, so that the device does not wait for the host.
        """
        gradient = gradient_by_photograph(self.losses, comparison)
        if planes.mask is not None:
            apply_mask(planes.workspace, planes.camera, gradient, planes.mask)
        of_images = transform.backward(planes, gradient)
        value, of_numbers = transform.penalty(transform.now(self.numbers), comparison.step)

        def learn() -> None:
            gradients = {name: derivative + of_numbers[name] for name, derivative in of_images().items()}
            transform.update(self.numbers, gradients, comparison.step)

        return [LossValue(name_of(transform), lambda: value)], [learn]

    def update(self, view: ViewGradients, stale: Collection[str] = ()) -> None:
        """Apply what `differentiate` returned: change parameters, moments and statistics."""
        grad_mean2d = self._update(view, stale)
        for learn in view.learning:
            learn()
        self.rasterizer.device.timings.section = "statistics"
        self.stats.add(view, grad_mean2d)

    def _update(self, view: ViewGradients, stale: Collection[str]) -> Array:
        """Update the parameters and add the penalties to the view's losses.

        Returns the gradient of the projected means, [2, S] px⁻¹.  Without penalties, stale parameters, motion
        and depths, gradients are not written to memory.
        """
        penalties = [loss for loss in self.losses if isinstance(loss, Penalty)]
        step = view.comparison.step
        rates = self.rates.at(step, self.extent)
        if not (penalties or stale or self.model.gaussians.moves or view.frame.content == "inverse_depth"):
            return self.adam.update(self.model, view.frame, view.pixel_sums, rates, self.rows)
        gradients = self.rasterizer.gradients(self.model, view.frame, view.pixel_sums)
        waits = self.rows == "deferred" or self.model.gaussians.on_host
        open_ones = gradients.without_deferred() if waits else gradients
        inputs = PenaltyInputs(self.rasterizer.workspace, self.model.gaussians, open_ones, self.extent, step)
        self.rasterizer.device.timings.section = "loss"
        view.losses.extend(returned(penalty, penalty.add(inputs)) for penalty in penalties)
        self.adam.step(self.model, view.frame, gradients, rates, stale, self.rows)
        return gradients.mean2d
