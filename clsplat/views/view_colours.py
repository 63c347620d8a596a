"""What a training has of the colours of its photographs, of whichever kind they are."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.schedule import Schedule
from clsplat.views.grid_tables import GridTables

TABLE = "colours"  # before the names of the numbers of a run
Floats = NDArray[np.float64]
LUMINANCE = np.array([0.299, 0.587, 0.114])  # BT.601
IDENTITY = np.eye(3, 4)
MEANING = "a colour c of the model, red, green and blue, is min(1, E c + b) in the photograph"


@dataclass(frozen=True)
class Written:
    """What a training leaves of the colours of its photographs."""

    matrices: dict[str, Floats]  # of each photograph, the mean where it has several, [3, 4]
    facts: dict[str, Any]  # for JSON: at least `meaning` and `type`, the name of the kind
    arrays: dict[str, NDArray[np.float32]] = field(default_factory=dict)  # by the names of files of NumPy's


class ViewColours(ABC):
    """The colours of the photographs of a training: where they begin, what a step does with them, what is left."""

    @property
    def device_tables(self) -> GridTables | None:
        """Tables on the device beside the numbers of a run, where there are such."""
        return None

    @abstractmethod
    def with_rate(self, rate: Schedule) -> Self:
        """Return the same with a learning rate."""

    @abstractmethod
    def begun(self, numbers: Mapping[str, float]) -> bool:
        """Whether the numbers of a run are those of these photographs."""

    @abstractmethod
    def begin(self, numbers: dict[str, float], log_gains: Mapping[str, Floats]) -> None:
        """Set the numbers before the first step.  log_gains: of red, green and blue by view, where known, [3]."""

    @abstractmethod
    def written(self, numbers: Mapping[str, float]) -> Written:
        """Return what the run folder gets of them at the end."""

    @abstractmethod
    def change(
        self, workspace: Workspace, camera: DeviceCamera, image: Array, numbers: Mapping[str, float], view: int
    ) -> tuple[Array, Callable[[], float]]:
        """Return an image, [3 or 4, rows, stride], in the colours of a training view, by its number, and what returns
        the loss of its numbers alone."""

    @abstractmethod
    def change_back(
        self,
        workspace: Workspace,
        camera: DeviceCamera,
        image: Array,
        gradient: Array,
        numbers: dict[str, float],
        view: int,
        step: int,
    ) -> tuple[Array, Callable[[], None]]:
        """Return the gradient by an image from that by what `change` made of it, and what changes the numbers."""
