"""The colours of the photographs while a model is trained: between the rendered image and the losses."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from clsplat.opencl.device import Array, Device
from clsplat.opencl.program import constants
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.schedule import Schedule, at_step
from clsplat.views.grid_tables import GridTables
from clsplat.views.own_colours import OwnColours
from clsplat.views.view_colours import MEANING, TABLE, Floats, ViewColours, Written
from clsplat.views.view_table import ViewTable

SUMS = int(constants("colours.cl")["SUMS"])
NAMES = tuple(f"{y}{c}" for y in "rgb" for c in "rgb1")  # of the kernels' arguments


class ColourModel(OwnColours):
    """Colours of which a photograph has one matrix for all its pixels."""

    def of_views(self, views: Sequence[str], device: Device, tables: GridTables | None) -> ViewColours:
        return PhotographColours(self, views, 0.0)

    @abstractmethod
    def matrix(self, row: Floats) -> Floats:
        """Return [E | b], [3, 4], of a photograph's numbers, [columns]."""

    @abstractmethod
    def gradient(self, row: Floats, by_matrix: Floats) -> Floats:
        """Return derivatives by a photograph's numbers, [columns], from those by its matrix, [3, 4]."""

    @abstractmethod
    def of_gains(self, log_gains: Floats) -> Floats:
        """Return the numbers, [columns], that come nearest to gains of red, green and blue: their logarithms, [3]."""

    def penalty(self, row: Floats) -> tuple[float, Floats]:
        """Return a loss of a photograph's numbers alone, and its derivatives."""
        return 0.0, np.zeros_like(row)


@dataclass(frozen=True)
class PhotographColours(ViewColours):
    """A model of colours, and the table with its numbers for each photograph."""

    model: ColourModel
    views: Sequence[str]  # names of the training views, by number; one of several sizes has one row
    rate: Schedule

    @property
    def table(self) -> ViewTable:
        """The table of the numbers."""
        return ViewTable(TABLE, tuple(dict.fromkeys(self.views)), self.model.columns)

    def with_rate(self, rate: Schedule) -> "PhotographColours":
        return replace(self, rate=rate)

    def begun(self, numbers: Mapping[str, float]) -> bool:
        return self.table.begun(numbers)

    def begin(self, numbers: dict[str, float], log_gains: Mapping[str, Floats]) -> None:
        self.table.begin(numbers, {view: self.model.of_gains(gains) for view, gains in log_gains.items()})

    def written(self, numbers: Mapping[str, float]) -> Written:
        rows = {view: self.table.row(numbers, view) for view in self.table.views}
        matrices = {view: self.model.matrix(row) for view, row in rows.items()}
        photographs = {
            view: {**dict(zip(self.model.columns, map(float, row), strict=True)), "matrix": matrices[view].tolist()}
            for view, row in rows.items()
        }
        kind = getattr(self.model, "type", type(self.model).__name__)
        meaning = f"{MEANING}; matrix: the rows of [E | b]"
        return Written(matrices, {"meaning": meaning, "type": kind, "photographs": photographs})

    def matrix(self, numbers: Mapping[str, float], view: int) -> Floats:
        """Return the matrix of a training view by its number, [3, 4]."""
        return self.model.matrix(self.table.row(numbers, self.views[view]))

    def penalty(self, numbers: Mapping[str, float], view: int) -> float:
        """Return the loss of a view's numbers alone."""
        return self.model.penalty(self.table.row(numbers, self.views[view]))[0]

    def change(
        self, workspace: Workspace, camera: DeviceCamera, image: Array, numbers: Mapping[str, float], view: int
    ) -> tuple[Array, Callable[[], float]]:
        penalty = self.penalty(numbers, view)
        return change_colours(workspace, camera, image, self.matrix(numbers, view)), lambda: penalty

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
        found, by_matrix = change_back(workspace, camera, image, self.matrix(numbers, view), gradient)
        return found, lambda: self.learn(numbers, view, by_matrix(), step)

    def learn(self, numbers: dict[str, float], view: int, by_matrix: Floats, step: int) -> None:
        """Change the numbers of a view; by_matrix: derivatives of the losses by its matrix, [3, 4]."""
        table, name = self.table, self.views[view]
        row = table.row(numbers, name)
        gradient = self.model.gradient(row, by_matrix) + self.model.penalty(row)[1]
        table.update(numbers, name, gradient, at_step(self.rate, step))


def change_colours(workspace: Workspace, camera: DeviceCamera, image: Array, matrix: Floats) -> Array:
    """Return an image, [3 or 4, rows, stride], with the colours that a matrix [3, 4] makes of its own."""
    found = workspace.array("coloured", image.shape)
    workspace.device.program("colours.cl").colours_forward(
        groups=(1, camera.rows), image=image, coloured=found, **_arguments(camera, image, matrix)
    )
    return found


def change_back(
    workspace: Workspace, camera: DeviceCamera, image: Array, matrix: Floats, gradient: Array
) -> tuple[Array, Callable[[], Floats]]:
    """Return the gradient by an image from that by what `change_colours` made of it, and a wait for that by the matrix.

    The sums of each row are added in double, in the order of rows.
    """
    found, sums = workspace.array("grad_coloured", image.shape), workspace.array("colour sums", (SUMS, camera.rows))
    workspace.device.program("colours.cl").colours_backward(
        groups=(1, camera.rows),
        image=image,
        gradient=gradient,
        grad_image=found,
        row_sums=sums,
        **_arguments(camera, image, matrix),
    )
    copied = sums.get_later()
    return found, lambda: np.cumsum(copied(), axis=1, dtype=np.float64)[:, -1].reshape(3, 4)


def _arguments(camera: DeviceCamera, image: Array, matrix: Floats) -> dict[str, Any]:
    values: dict[str, Any] = dict(zip(NAMES, map(float, matrix.ravel()), strict=True))
    return {**values, "channels": image.shape[0], **camera.plane_arguments()}
