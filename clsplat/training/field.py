"""Define the interface of a trained field (a model without Gaussians) for runs and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.opencl.device import Array
from clsplat.render.painter import Painter

FOLDER = "field/"  # before the names of its tables in a checkpoint
Tables = dict[str, NDArray[np.float32]]


class TrainedField(ABC):
    """A field in training.  Checkpoints refer to subclasses by their `kind`."""

    kinds: ClassVar[dict[str, type["TrainedField"]]] = {}
    kind: ClassVar[str]
    updates: int  # of Adam, for its bias correction
    rate: float  # of the last step

    def __init_subclass__(cls) -> None:
        TrainedField.kinds[cls.kind] = cls

    @property
    @abstractmethod
    def painter(self) -> Painter:
        """The renderer of its views."""

    @property
    @abstractmethod
    def parameters(self) -> int:
        """The number of learned parameters."""

    @abstractmethod
    def shape_as_data(self) -> dict[str, Any]:
        """Return the `shape` for `check_tables` and `from_tables`, as JSON."""

    @abstractmethod
    def tables(self) -> Tables:
        """Copy the tables to the host."""

    @abstractmethod
    def not_finite(self) -> list[str]:
        """Return the names of the tables that hold NaN or infinity."""

    @classmethod
    @abstractmethod
    def check_tables(cls, shape: Mapping[str, Any], tables: Tables, others: Tables) -> None:
        """Raise DataError if tables do not fit a field of this shape, or if there are `others`."""

    @classmethod
    @abstractmethod
    def from_tables(
        cls, shape: Mapping[str, Any], tables: Mapping[str, NDArray[np.float32]], background: Array
    ) -> Self:
        """Return the field of a checkpoint from its tables."""


def field_class(entry: Mapping[str, Any]) -> type[TrainedField]:
    """Return the class of a field in a checkpoint.  Raises DataError for an unknown kind."""
    kind = TrainedField.kinds.get(str(entry.get("kind")))
    if kind is None or not isinstance(entry.get("shape"), dict):
        raise DataError(f"it holds a field of an unknown kind; expected {', '.join(TrainedField.kinds)}")
    return kind
