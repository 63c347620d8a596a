"""Define the interface of trained fields, which are models without Gaussians, for runs and checkpoints."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from clsplat.core.errors import DataError
from clsplat.opencl.device import Array
from clsplat.render.painter import Painter

FOLDER = "field/"  # prefix of its tables in a checkpoint
Tables = dict[str, NDArray[np.float32]]


class TrainedField(ABC):
    """A field in training.  Checkpoints identify subclasses by `kind`."""

    kinds: ClassVar[dict[str, type["TrainedField"]]] = {}
    kind: ClassVar[str]
    updates: int  # number of Adam updates, for the bias correction
    rate: float  # learning rate of the last step

    def __init_subclass__(cls) -> None:
        TrainedField.kinds[cls.kind] = cls

    @property
    @abstractmethod
    def painter(self) -> Painter:
        """The renderer of the field."""

    @property
    @abstractmethod
    def parameter_count(self) -> int:
        """The number of trained parameters."""

    @abstractmethod
    def shape_as_data(self) -> dict[str, Any]:
        """Return the `shape` argument of `check_tables` and `from_tables`, as JSON data."""

    @abstractmethod
    def tables(self) -> Tables:
        """Copy the tables to the host, keyed by name."""

    @abstractmethod
    def find_nonfinite(self) -> list[str]:
        """Return the names of the tables that contain NaN or infinity."""

    @classmethod
    @abstractmethod
    def check_tables(cls, shape: Mapping[str, Any], tables: Tables, extra_tables: Tables) -> None:
        """Raise DataError if tables do not fit a field of this shape, or if there are tables that no field has."""

    @classmethod
    @abstractmethod
    def from_tables(
        cls, shape: Mapping[str, Any], tables: Mapping[str, NDArray[np.float32]], background: Array
    ) -> Self:
        """Create a field from the tables of a checkpoint.  background: color, [3]."""


def field_class(entry: Mapping[str, Any]) -> type[TrainedField]:
    """Return the class of a field in a checkpoint.  Raises DataError for an unknown kind."""
    field_type = TrainedField.kinds.get(str(entry.get("kind")))
    if field_type is None or not isinstance(entry.get("shape"), dict):
        raise DataError(f"it contains a field of an unknown kind; expected {', '.join(TrainedField.kinds)}")
    return field_type
