"""What a run and its checkpoint need of a field: a model that is not made of Gaussians."""

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
    """A field while it is trained.  Checkpoints know a subclass by its `kind` as soon as it is defined."""

    kinds: ClassVar[dict[str, type["TrainedField"]]] = {}
    kind: ClassVar[str]
    updates: int  # by Adam, which count for the bias of its moments
    rate: float  # of the last step

    def __init_subclass__(cls) -> None:
        TrainedField.kinds[cls.kind] = cls

    @property
    @abstractmethod
    def painter(self) -> Painter:
        """What renders views of it."""

    @property
    @abstractmethod
    def parameters(self) -> int:
        """The number of parameters that are learned."""

    @abstractmethod
    def shape_as_data(self) -> dict[str, Any]:
        """Return what `check_tables` and `of_tables` take as `shape`, as JSON holds it."""

    @abstractmethod
    def tables(self) -> Tables:
        """Copy its tables to the host."""

    @abstractmethod
    def not_finite(self) -> list[str]:
        """Return the names of the tables that hold NaN or infinity."""

    @classmethod
    @abstractmethod
    def check_tables(cls, shape: Mapping[str, Any], tables: Tables, others: Tables) -> None:
        """Raise DataError for tables that are not those of a field of a shape."""

    @classmethod
    @abstractmethod
    def of_tables(cls, shape: Mapping[str, Any], tables: Mapping[str, NDArray[np.float32]], background: Array) -> Self:
        """Return the field of a checkpoint, by what `tables` has returned."""


def class_of(written: Mapping[str, Any]) -> type[TrainedField]:
    """Return the class of a field in a checkpoint.  Raises DataError where no module defines it."""
    kind = TrainedField.kinds.get(str(written.get("kind")))
    if kind is None or not isinstance(written.get("shape"), dict):
        raise DataError(f"it holds a field of an unknown kind; expected {', '.join(TrainedField.kinds)}")
    return kind
