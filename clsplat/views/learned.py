"""A transform of the photograph whose numbers training learns, together with the Gaussians, and their Adam.

The numbers and Adam's moments lie in one dictionary by name, which a run keeps in its checkpoints.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

from clsplat.opencl.device import Array
from clsplat.schedule import NonNegative, at_step
from clsplat.views.adam import ByNumber, adam_step
from clsplat.views.transforms import PhotographTransform, Planes


class LearnedTransform(PhotographTransform):
    """A transform with numbers of its own, which training learns; it stands last, and there is one at most.

    Its `apply` leaves the colours that it is given as they are, and returns them as `source`.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    rate_keys: ClassVar[frozenset[str]] = frozenset({"rate"})

    rate: NonNegative
    """Learning rate of the numbers; by step."""

    @abstractmethod
    def first(self) -> ByNumber:
        """Return the numbers before the first step, by names that no other part of a run uses."""

    @abstractmethod
    def penalty(self, numbers: ByNumber, step: int) -> tuple[float, ByNumber]:
        """Return a loss of the numbers alone, and its derivatives."""

    @abstractmethod
    def backward(self, planes: Planes, gradient: Array) -> Callable[[], ByNumber]:
        """Begin the derivatives by the numbers of what `apply` returned; the result waits for them.

        gradient: by the colours of `planes`, [3, rows, stride], zero outside the image and where the mask is.
        """

    def now(self, numbers: Mapping[str, float]) -> ByNumber:
        """Return the transform's own numbers; the first ones where there are none yet."""
        return {name: numbers.get(name, first) for name, first in self.first().items()}

    def update(self, numbers: dict[str, float], gradients: ByNumber, step: int) -> None:
        """Change the numbers by Adam."""
        adam_step(numbers, self.now(numbers), gradients, at_step(self.rate, step))


def learned_of(transforms: Sequence[PhotographTransform]) -> LearnedTransform | None:
    """Return the transform that learns, or None.  Raises ValueError where another one follows it."""
    learned = [transform for transform in transforms if isinstance(transform, LearnedTransform)]
    if learned and learned[0] is not transforms[-1]:
        name = name_of(learned[0])
        raise ValueError(f"a transform follows '{name}', which learns; expected one that learns at the end of the list")
    return learned[0] if learned else None


def name_of(transform: PhotographTransform) -> str:
    """Return the name of a transform in pipeline files; that of its class where it has none."""
    return str(getattr(transform, "type", type(transform).__name__))
