"""A transform of the photograph whose numbers are learned.  The views bring it: no list names it."""

from typing import Any, ClassVar

from clsplat.losses.base import LossValue, gradient_by_photograph
from clsplat.photos.photographs import apply_mask
from clsplat.photos.transforms import learned_of, name_of
from clsplat.training.modules.base import ModuleState, Numbers, Step, TrainingModule
from clsplat.training.run import Run


class TransformModule(TrainingModule):
    """A transform of the photograph that learns.  The views bring it: no list names it."""

    brought_as: ClassVar[str] = "learned_transform"
    place: ClassVar[int] = 100

    @classmethod
    def brought(cls, run: Run, stage: Any) -> "TransformModule | None":
        transforms = getattr(getattr(stage, "views", None), "transforms", ())
        return cls(type=cls.brought_as) if learned_of(transforms) else None

    def state(self, run: Run) -> "LearnedTransformState":
        return LearnedTransformState(run.numbers)


class LearnedTransformState(ModuleState):
    """The transform in a step."""

    is_saved: ClassVar[bool] = False

    def __init__(self, numbers: Numbers) -> None:
        super().__init__()
        self.numbers = numbers  # those of the run

    def before_losses(self, step: Step) -> None:
        """A loss keeps the sums of its last call, so that the gradient by the photograph comes before its value."""
        if not (transform := learned_of(step.transforms)):
            return
        planes = step.planes
        gradient = gradient_by_photograph(step.losses_asked, step.comparison)
        if planes.mask is not None:
            apply_mask(planes.workspace, planes.camera, gradient, planes.mask)
        of_images = transform.backward(planes, gradient)
        value, of_numbers = transform.penalty(transform.now(self.numbers), step.number)
        step.own_losses.append(LossValue(name_of(transform), lambda: value))
        step.keep(self, (transform, of_images, of_numbers))

    def update(self, step: Step) -> None:
        if kept := step.kept(self):
            transform, of_images, of_numbers = kept
            gradients = {name: derivative + of_numbers[name] for name, derivative in of_images().items()}
            transform.update(self.numbers, gradients, step.number)
