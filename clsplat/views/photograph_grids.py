"""The grids of the photographs while a model is trained: colours by place and luminance (cl_kernels/colour_grid.cl)."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.opencl.device import Array, Device
from clsplat.opencl.program import constants
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.schedule import Schedule, at_step
from clsplat.views.adam import ADAM
from clsplat.views.colours import Floats, Grid
from clsplat.views.photograph_colours import TABLE, ViewColours

ENTRIES = int(constants("colour_grid.cl")["ENTRIES"])
NAMES = ("values", "moment1", "moment2")
Tables = dict[str, NDArray[np.float32]]


class GridTables:
    """The grids of all photographs on the device, with Adam's moments: each [photographs, row]."""

    def __init__(self, device: Device, shape: tuple[int, int]) -> None:
        """The values are differences from no change, 0 at first.  shape: photographs, ENTRIES * nz * ny * nx."""
        self.device, self.shape = device, shape
        self.arrays: dict[str, Array] = {name: device.zeros(shape) for name in NAMES}

    def set(self, tables: Mapping[str, NDArray[np.float32]]) -> None:
        """Take tables of a checkpoint; those that it does not have become 0."""
        for name, array in self.arrays.items():
            array.set(np.ascontiguousarray(tables.get(name, np.zeros(self.shape, np.float32))))

    def tables(self, names: Sequence[str] = NAMES) -> Tables:
        """Copy tables to the host."""
        return {name: self.arrays[name].get() for name in names}

    def centre(self, levels: int) -> None:
        """Subtract the mean over photographs and places at each of so many levels of luminance."""
        photographs, row = self.shape
        self.device.program("colour_grid_table.cl").colour_grid_centre(
            groups=ENTRIES * levels,
            values=self.arrays["values"],
            places=row // (ENTRIES * levels),
            photographs=photographs,
        )


def row_length(cells: Sequence[int]) -> int:
    """Return the values of one photograph."""
    return ENTRIES * math.prod(cells)


def bytes_of(cells: Sequence[int], photographs: int, rows: int, pixels: int) -> int:
    """Return what grids take on the device.  rows, pixels: of the largest view, whole tiles."""
    row, columns = row_length(cells), ENTRIES * cells[0] * cells[2]
    return 4 * (len(NAMES) * photographs * row + 3 * row + columns * rows + 3 * pixels)


@dataclass(frozen=True)
class PhotographGrids(ViewColours):
    """The grids, and what the numbers of a run have of them: the row of each photograph and its updates."""

    model: Grid
    views: Sequence[str]  # names of the training views, by number; one of several sizes has one row
    rate: Schedule
    tables: GridTables

    @property
    def names(self) -> list[str]:
        """The names of the photographs, by row."""
        return list(dict.fromkeys(self.views))

    def begun(self, numbers: Mapping[str, float]) -> bool:
        """Whether the numbers of a run say that the tables are those of these photographs."""
        return all(numbers.get(f"{TABLE}/{view}/row") == row for row, view in enumerate(self.names))

    def begin(self, numbers: dict[str, float], log_gains: Mapping[str, Floats]) -> None:
        """Set the tables before the first step.  log_gains: of red, green and blue by view, where known, [3]."""
        matrices = np.zeros((len(self.names), 3, 4))
        for row, view in enumerate(self.names):
            matrices[row, range(3), range(3)] = np.expm1(log_gains.get(view, np.zeros(3)))
            numbers |= {f"{TABLE}/{view}/row": float(row), f"{TABLE}/{view}/updates": 0.0}
        values = np.repeat(matrices.reshape(len(matrices), ENTRIES), math.prod(self.model.cells), axis=1)
        self.tables.set({"values": values.astype(np.float32)})
        self.tables.centre(self.model.cells[2])

    def row(self, view: int) -> int:
        """Return the row of a training view by its number."""
        return self.names.index(self.views[view])

    def change(
        self, workspace: Workspace, camera: DeviceCamera, image: Array, numbers: Mapping[str, float], view: int
    ) -> tuple[Array, Callable[[], float]]:
        found = self._changed(workspace, camera, image, view)
        shares = self._smoothness(workspace, view)
        return found, lambda: float(shares.get().sum(dtype=np.float64))

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
        found, by_grid = self.differentiated(workspace, camera, image, gradient, view)
        return found, lambda: self.learn(workspace, numbers, view, by_grid, step)

    def _changed(self, workspace: Workspace, camera: DeviceCamera, image: Array, view: int) -> Array:
        found = workspace.array("coloured", image.shape)
        workspace.device.program("colour_grid.cl").colour_grid_forward(
            groups=(1, camera.rows), image=image, coloured=found, **self._arguments(camera, image, view)
        )
        return found

    def _smoothness(self, workspace: Workspace, view: int) -> Array:
        """Write the derivatives of the smoothness; return its shares, whose sum it is."""
        nodes, row = dict(zip("xyz", self.model.cells, strict=True)), row_length(self.model.cells)
        sizes: dict[str, Any] = {f"n{axis}": n for axis, n in nodes.items()}
        by_smoothness, shares = (workspace.array(f"grid {name}", row) for name in ("smoothness", "shares"))
        differences = {axis: row // n * (n - 1) for axis, n in nodes.items()}
        sizes |= {f"weight_{axis}": self.model.weight / max(number, 1) for axis, number in differences.items()}
        workspace.device.program("colour_grid_table.cl").colour_grid_smoothness(
            items=row,
            values=self.tables.arrays["values"],
            by_smoothness=by_smoothness,
            shares=shares,
            first=self.row(view) * row,
            count=row,
            **sizes,
        )
        return shares

    def differentiated(
        self, workspace: Workspace, camera: DeviceCamera, image: Array, gradient: Array, view: int
    ) -> tuple[Array, Array]:
        """Return the gradient by an image from that by what `change` made of it, and that by the grid, [row]."""
        (nx, _, nz), row = self.model.cells, row_length(self.model.cells)
        found = workspace.array("grad_coloured", image.shape)
        passed = workspace.array("grid passed", (3, *image.shape[1:]))
        sums, by_grid = (
            workspace.array("grid row sums", (ENTRIES * nz * nx, camera.rows)),
            workspace.array("by grid", row),
        )
        program, arguments = workspace.device.program("colour_grid.cl"), self._arguments(camera, image, view)
        program.colour_grid_backward(
            groups=(1, camera.rows), image=image, gradient=gradient, grad_image=found, passed=passed, **arguments
        )
        of_rows = ("nx", "nz", "per_column", "width", "rows", "stride")
        program.colour_grid_row_sums(
            groups=(nx, camera.rows),
            image=image,
            passed=passed,
            row_sums=sums,
            **{name: arguments[name] for name in of_rows},
        )
        of_nodes = ("nx", "ny", "per_row", "height", "rows")
        program.colour_grid_gather(
            items=row, row_sums=sums, by_grid=by_grid, count=row, **{name: arguments[name] for name in of_nodes}
        )
        return found, by_grid

    def learn(self, workspace: Workspace, numbers: dict[str, float], view: int, by_grid: Array, step: int) -> None:
        """Change the grid of a view by Adam, with a count of updates of its own, then centre all.

        by_grid: derivatives of the losses of the image, [row]; those of the smoothness are as `change` left them.
        """
        key, row = f"{TABLE}/{self.views[view]}/updates", row_length(self.model.cells)
        numbers[key] = updates = numbers.get(key, 0.0) + 1
        arguments: dict[str, Any] = dict(self.tables.arrays)
        workspace.device.program("colour_grid_table.cl").colour_grid_update(
            items=row,
            by_grid=by_grid,
            by_smoothness=workspace.array("grid smoothness", row),
            **arguments,
            first=self.row(view) * row,
            rate=at_step(self.rate, step) / (1 - ADAM["BETA1"] ** updates),
            correction2=1 / (1 - ADAM["BETA2"] ** updates),
            count=row,
        )
        self.tables.centre(self.model.cells[2])

    def _arguments(self, camera: DeviceCamera, image: Array, view: int) -> dict[str, Any]:
        nx, ny, nz = self.model.cells
        return {
            "values": self.tables.arrays["values"],
            "first": self.row(view) * row_length(self.model.cells),
            **{"nx": nx, "ny": ny, "nz": nz, "channels": image.shape[0]},
            "per_column": (nx - 1) / camera.width,
            "per_row": (ny - 1) / camera.height,
            **camera.plane_arguments(),
        }
