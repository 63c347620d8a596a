"""Colour grids: how a pipeline file names them, and what a training does with them (cl_kernels/colour_grid.cl)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.core.files import VIEW_COLOURS, VIEW_GRIDS
from clsplat.core.schedule import Decay, Points, Schedule, at_step
from clsplat.opencl.device import Array, Device, constants
from clsplat.photos.appearance import (
    ADAM,
    ENTRIES,
    IDENTITY,
    LUMINANCE,
    MEANING,
    TABLE,
    Floats,
    GridTables,
    OwnColours,
    RateOrAuto,
    ViewColours,
    Written,
    bytes_of,
    fitted_gains,
    row_length,
)
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace

WARM_UP = 1000  # steps in which the rate of grids grows from 1 % of itself (gsplat); a tenth of shorter trainings
Nodes = Annotated[int, Field(ge=1, le=int(constants("colour_grid.h")["MOST_NODES"]))]
GRID_MEANING = (
    f"{MEANING}; [E | b] is the trilinear mean of the matrices about a pixel; file: matrices [photographs, luminance, "
    "height, width, 3, 4], float32, the outer ones on the edges of the image, at black and at white of "
    "{} red + {} green + {} blue; matrix: the mean of a photograph's"
).format(*LUMINANCE)


class Grid(OwnColours):
    """Colours of each photograph by place and luminance: a bilateral grid of affine changes (Wang et al. 2024).

    It follows what a phone does to parts of a photograph, local tone mapping, which the other kinds cannot.  It also
    follows what the model should learn, so that held-out photographs are often worse with it: try `gain` first.  The
    mean over photographs and places stays that of no change at each luminance; figures are in colours of `gain`.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})
    columns: ClassVar[tuple[str, ...]] = ("row",)  # of its grid in the tables of a run

    type: Literal["grid"] = "grid"
    cells: Annotated[list[Nodes], Field(min_length=3, max_length=3)] = Field([4, 4, 4])
    """Matrices along the width, the height and the luminance, 1 to 16 each.  Between them colours are trilinear; the
    outer ones lie on the edges, at black and at white.  Published are [16, 16, 8]."""
    rate: RateOrAuto = "auto"
    """Learning rate of the matrices, by Adam, by step; auto: 2e-3 to 2e-5 (gsplat), where no tracks tell the exposures
    that of `gain`; it grows from 1 % of itself in 1000 steps, or a tenth of fewer than 10 000.  At most 0.5."""
    weight: Annotated[float, Field(ge=0)] = 10.0
    """Factor of the loss that makes the grid of the photograph of a step smooth: the sum over the axes of the mean of
    the squared differences of neighbours."""

    @property
    def files(self) -> tuple[str, ...]:
        return VIEW_COLOURS, VIEW_GRIDS

    def of_views(self, views: Sequence[str], device: Device, tables: GridTables | None) -> ViewColours:
        photographs = len(set(views))
        if tables is None or not tables.fit(photographs, self.cells):
            tables = GridTables(device, photographs, self.cells)
        return PhotographGrids(self, views, 0.0, tables)

    def device_bytes(self, photographs: int, rows: int, pixels: int) -> int:
        return bytes_of(self.cells, photographs, rows, pixels)

    def rate_of(self, steps: int, photographs: int, known: bool = True) -> Schedule:
        if self.rate != "auto":
            return self.rate
        of_gains = super().rate_of(steps, photographs, known)
        rate = Decay(initial=2e-3, final=2e-5, over=steps) if known else of_gains
        warm_up = max(1, min(WARM_UP, steps // 10))
        later = [warm_up + round((steps - warm_up) * share) for share in np.linspace(0, 1, 11)]
        points = {step: [float(step), at_step(rate, step)] for step in later}
        return Points(points=[[0.0, at_step(rate, 0) / 100], *points.values()])

    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        """A grid that was fitted in one place says nothing of another: the colours are those of `gain`."""
        return fitted_gains(image, photograph)


@dataclass(frozen=True)
class PhotographGrids(ViewColours):
    """The grids, and what the numbers of a run have of them: the row of each photograph and its updates."""

    model: "Grid"
    views: Sequence[str]  # names of the training views, by number; one of several sizes has one row
    rate: Schedule
    tables: GridTables

    @property
    def names(self) -> list[str]:
        """The names of the photographs, by row."""
        return list(dict.fromkeys(self.views))

    @property
    def device_tables(self) -> GridTables:
        return self.tables

    def with_rate(self, rate: Schedule) -> "PhotographGrids":
        return replace(self, rate=rate)

    def begun(self, numbers: Mapping[str, float]) -> bool:
        return all(numbers.get(f"{TABLE}/{view}/row") == row for row, view in enumerate(self.names))

    def begin(self, numbers: dict[str, float], log_gains: Mapping[str, Floats]) -> None:
        matrices = np.zeros((len(self.names), 3, 4))
        for row, view in enumerate(self.names):
            matrices[row, range(3), range(3)] = np.expm1(log_gains.get(view, np.zeros(3)))
            numbers |= {f"{TABLE}/{view}/row": float(row), f"{TABLE}/{view}/updates": 0.0}
        values = matrices.reshape(len(matrices), ENTRIES, 1, 1, 1).astype(np.float32)
        self.tables.set({"values": np.broadcast_to(values, self.tables.shape)})
        self.tables.centre()

    def written(self, numbers: Mapping[str, float]) -> Written:
        values = self.tables.tables(["values"])["values"]
        grids = values.reshape(-1, 3, 4, *values.shape[2:]).transpose(0, 3, 4, 5, 1, 2) + IDENTITY.astype(np.float32)
        means = {view: one.mean(axis=(0, 1, 2), dtype=np.float64) for view, one in zip(self.names, grids, strict=True)}
        rows = {view: {"row": row, "matrix": means[view].tolist()} for row, view in enumerate(self.names)}
        facts = {
            "meaning": GRID_MEANING,
            "type": self.model.type,
            "cells": list(self.model.cells),
            "file": VIEW_GRIDS,
            "photographs": rows,
        }
        return Written(means, facts, {VIEW_GRIDS: np.ascontiguousarray(grids, np.float32)})

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
        self.tables.centre()

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
