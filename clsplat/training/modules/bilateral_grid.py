"""Fit a bilateral grid of color transforms to each photograph (cl_kernels/color_grid.cl)."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.core.errors import DataError
from clsplat.core.schedule import Decay, Points, Schedule, at_step
from clsplat.losses.base import LossValue
from clsplat.opencl.device import Array, Device, constants
from clsplat.photos.appearance import ADAM, IDENTITY, LUMINANCE, MEANING, Floats
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.scene.view import View
from clsplat.training.modules.base import Scalars, Tables, TrainingStep
from clsplat.training.modules.exposure import (
    TABLE,
    VIEW_COLORS,
    Appearance,
    ColorReport,
    ColorState,
    Gain,
    RateOrAuto,
)
from clsplat.training.run import Run

VIEW_GRIDS = "view_colors.npy"
ENTRIES = int(constants("color_grid.h")["ENTRIES"])
TABLES = ("values", "moment1", "moment2")
WARM_UP_STEPS = 1000  # steps (gsplat), or a tenth of the steps of a shorter run
Nodes = Annotated[int, Field(ge=1, le=int(constants("color_grid.h")["MOST_NODES"]))]
GRID_MEANING = (
    f"{MEANING}; [E | b] is interpolated trilinearly; file: matrices [photographs, luminance, height, width, 3, 4], "
    "float32, the outer ones on the edges of the image, at black and white of {} red + {} green + {} blue; "
    "matrix: the mean of a photo's matrices"
).format(*LUMINANCE)


class BilateralGrid(Appearance):
    """Learn a bilateral grid of affine color transforms per photograph (Wang et al. 2024).

    It can represent the local tone mapping of phones, which `exposure` cannot.  It also absorbs colors that the model
    should learn, so test views are often worse with it: try `exposure` first.  At each luminance, the mean transform
    over photographs and positions remains the identity.  A grid cannot be fitted to one half of a photograph and tested
    on the other half, so metrics use the color model `gain`.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})

    type: Literal["bilateral_grid"] = "bilateral_grid"
    grid_shape: Annotated[list[Nodes], Field(min_length=3, max_length=3)] = Field([4, 4, 4])
    """Numbers of matrices along width, height, and luminance, 1 to 16 each.  They are interpolated trilinearly; the
    outer matrices are at the edges of the photo, and at black and white.  The paper uses [16, 16, 8]."""
    rate: RateOrAuto = "auto"
    """Learning rate, at most 0.5; may be scheduled.  auto: 2e-3 to 2e-5 (gsplat), or the automatic rate of `exposure`
    if exposures are unknown.  Both rise from 1% in the first 1000 steps, or in a tenth of all steps if fewer."""
    weight: Annotated[float, Field(ge=0)] = 10.0
    """Weight of the total variation loss of the step's grid: the mean squared difference of adjacent nodes, summed over
    the axes."""

    side_files: ClassVar[Mapping[str, str]] = {VIEW_COLORS: "colors", VIEW_GRIDS: "bilateral grids"}
    device_planes: ClassVar[int] = 9  # including the gradient before clipping at white

    def create_state(self, run: Run) -> "GridState":
        return GridState(self, [view.name for view in run.scene.split("train")], run.device)

    def device_bytes(self, views: Sequence[View], tile: int) -> int:
        if self.chosen == "off":
            return 0
        rows = max(-(-view.camera.height // tile) * tile for view in views)
        return super().device_bytes(views, tile) + grid_bytes(self.grid_shape, len({view.name for view in views}), rows)

    @classmethod
    def check_saved(cls, scalars: Scalars, tables: Tables) -> None:
        super().check_saved(scalars, tables)
        shapes = {table.shape for table in tables.values()}
        if tables.keys() not in ({*TABLES}, {*TABLES[:1]}) or len(shapes) != 1 or shapes.pop()[1:2] != (ENTRIES,):
            raise DataError(f"its grids do not have the shape [photographs, {ENTRIES}, nz, ny, nx]")
        rows, count = sorted(row for key, row in scalars.items() if key.endswith("/row")), len(tables["values"])
        if rows != list(range(count)):
            raise DataError(
                f"it has bilateral grids for {count} photos, but their rows are not numbered from 0 to {count - 1}"
            )

    def rate_schedule(self, steps: int, photographs: int, is_warm_start: bool = True) -> Schedule:
        if self.rate != "auto":
            return self.rate
        exposure_rate = super().rate_schedule(steps, photographs, is_warm_start)
        rate = Decay(initial=2e-3, final=2e-5, over=steps) if is_warm_start else exposure_rate
        warm_up = max(1, min(WARM_UP_STEPS, steps // 10))
        knots = [warm_up + round((steps - warm_up) * t) for t in np.linspace(0, 1, 11)]
        points = {step: [float(step), at_step(rate, step)] for step in knots}
        return Points(points=[[0.0, at_step(rate, 0) / 100], *points.values()])

    @property
    def color_model(self) -> Gain:
        return Gain()


class GridState(ColorState):
    """The grids of all photographs on the device, and their Adam moments, each [photographs, ENTRIES, nz, ny, nx]."""

    settings: BilateralGrid

    def __init__(self, settings: BilateralGrid, views: Sequence[str], device: Device) -> None:
        super().__init__(settings, views)
        self.device, self.shape = device, (len(self.names), ENTRIES, *reversed(settings.grid_shape))
        self.arrays: dict[str, Array] = {name: device.zeros(self.shape) for name in TABLES}

    def tables(self, full: bool = True) -> Tables:
        return {name: self.arrays[name].get() for name in (TABLES if full else TABLES[:1])}

    def can_load(self, scalars: Scalars, tables: Tables) -> bool:
        return "values" in tables and tables["values"].shape == self.shape

    def load(self, scalars: Scalars, tables: Tables) -> None:
        """Restore the state, with zeros for missing tables."""
        super().load(scalars, tables)
        for name, array in self.arrays.items():
            array.set(np.ascontiguousarray(tables.get(name, np.zeros(self.shape, np.float32))))

    def start_from(self, log_gains: Mapping[str, Floats]) -> None:
        matrices = np.zeros((len(self.names), 3, 4))
        for row, view in enumerate(self.names):
            matrices[row, range(3), range(3)] = np.expm1(log_gains.get(view, np.zeros(3)))
            self.scalars |= {f"{TABLE}/{view}/row": float(row), f"{TABLE}/{view}/updates": 0.0}
        values = matrices.reshape(len(matrices), ENTRIES, 1, 1, 1).astype(np.float32)
        self.load(self.scalars, {"values": np.broadcast_to(values, self.shape)})
        self._center()

    def row(self, view: int) -> int:
        """Return the index of a training view's grid.  view: the index of the view."""
        return self.names.index(self.views[view])

    def after_render(self, step: TrainingStep) -> None:
        if step.view_index is None:
            return
        image = step.image
        step.image = self.transform(step.workspace, step.camera, image, step.view_index)
        terms = self.smoothness(step.workspace, step.view_index)
        step.module_losses.append(LossValue("colors", lambda: float(terms.get().sum(dtype=np.float64))))
        step.save(self, (image, []))

    def backward(self, step: TrainingStep) -> None:
        if (saved := step.saved_value(self)) and step.view_index is not None:
            step.gradient, grad_grid = self.differentiate(
                step.workspace, step.camera, saved[0], step.gradient, step.view_index
            )
            saved[1].append(grad_grid)

    def update(self, step: TrainingStep) -> None:
        if (saved := step.saved_value(self)) and step.view_index is not None:
            self.learn(step.workspace, step.view_index, saved[1][0], step.number)

    def report(self) -> ColorReport:
        values = self.arrays["values"].get()
        grids = values.reshape(-1, 3, 4, *values.shape[2:]).transpose(0, 3, 4, 5, 1, 2) + IDENTITY.astype(np.float32)
        means = {
            view: grid.mean(axis=(0, 1, 2), dtype=np.float64) for view, grid in zip(self.names, grids, strict=True)
        }
        rows = {view: {"row": row, "matrix": means[view].tolist()} for row, view in enumerate(self.names)}
        facts = {
            "meaning": GRID_MEANING,
            "type": self.settings.type,
            "grid_shape": list(self.settings.grid_shape),
            "file": VIEW_GRIDS,
            "photographs": rows,
        }
        return ColorReport(means, facts, {VIEW_GRIDS: np.ascontiguousarray(grids, np.float32)})

    def transform(self, workspace: Workspace, camera: DeviceCamera, image: Array, view: int) -> Array:
        """Apply a training view's grid to an image, [3 or 4, rows, stride].  view: the index of the view."""
        result = workspace.array("colored", image.shape)
        workspace.device.program("color_grid.cl").color_grid_forward(
            groups=(1, camera.rows), image=image, colored=result, **self._arguments(camera, image, view)
        )
        return result

    def smoothness(self, workspace: Workspace, view: int) -> Array:
        """Write the gradient of the total variation loss to the workspace, and return the terms of the loss, [row]."""
        nodes, row = dict(zip("xyz", self.settings.grid_shape, strict=True)), row_length(self.settings.grid_shape)
        sizes: dict[str, Any] = {f"n{axis}": n for axis, n in nodes.items()}
        grad_smoothness, terms = (workspace.array(f"grid {name}", row) for name in ("smoothness", "terms"))
        differences = {axis: row // n * (n - 1) for axis, n in nodes.items()}
        sizes |= {f"weight_{axis}": self.settings.weight / max(number, 1) for axis, number in differences.items()}
        workspace.device.program("color_grid_table.cl").color_grid_smoothness(
            items=row,
            values=self.arrays["values"],
            grad_smoothness=grad_smoothness,
            terms=terms,
            first=self.row(view) * row,
            count=row,
            **sizes,
        )
        return terms

    def differentiate(
        self, workspace: Workspace, camera: DeviceCamera, image: Array, gradient: Array, view: int
    ) -> tuple[Array, Array]:
        """Return the gradients of `image` and of the grid, [row].  gradient: gradient of the result of `transform`."""
        (nx, _, nz), row = self.settings.grid_shape, row_length(self.settings.grid_shape)
        result = workspace.array("grad_colored", image.shape)
        unclamped = workspace.array("grid passed", (3, *image.shape[1:]))
        sums, grad_grid = (
            workspace.array("grid row sums", (ENTRIES * nz * nx, camera.rows)),
            workspace.array("grad_grid", row),
        )
        program, arguments = workspace.device.program("color_grid.cl"), self._arguments(camera, image, view)
        program.color_grid_backward(
            groups=(1, camera.rows), image=image, gradient=gradient, grad_image=result, passed=unclamped, **arguments
        )
        row_names = ("nx", "nz", "per_column", "width", "rows", "stride")
        program.color_grid_row_sums(
            groups=(nx, camera.rows),
            image=image,
            passed=unclamped,
            row_sums=sums,
            **{name: arguments[name] for name in row_names},
        )
        node_names = ("nx", "ny", "per_row", "height", "rows")
        program.color_grid_gather(
            items=row, row_sums=sums, grad_grid=grad_grid, count=row, **{name: arguments[name] for name in node_names}
        )
        return result, grad_grid

    def _arguments(self, camera: DeviceCamera, image: Array, view: int) -> dict[str, Any]:
        nx, ny, nz = self.settings.grid_shape
        return {
            "values": self.arrays["values"],
            "first": self.row(view) * row_length(self.settings.grid_shape),
            **{"nx": nx, "ny": ny, "nz": nz, "channels": image.shape[0]},
            "per_column": (nx - 1) / camera.width,
            "per_row": (ny - 1) / camera.height,
            **camera.plane_arguments(),
        }

    def learn(self, workspace: Workspace, view: int, grad_grid: Array, step: int) -> None:
        """Update the grid of a view with Adam, with a separate update count for each grid.  Then center all grids.

        grad_grid: gradient of the image losses, [row].  The gradient of the total variation is in the workspace.
        """
        key, row = f"{TABLE}/{self.views[view]}/updates", row_length(self.settings.grid_shape)
        self.scalars[key] = updates = self.scalars.get(key, 0.0) + 1
        arguments: dict[str, Any] = dict(self.arrays)
        workspace.device.program("color_grid_table.cl").color_grid_update(
            items=row,
            grad_grid=grad_grid,
            grad_smoothness=workspace.array("grid smoothness", row),
            **arguments,
            first=self.row(view) * row,
            rate=at_step(self.rate, step) / (1 - ADAM["BETA1"] ** updates),
            correction2=1 / (1 - ADAM["BETA2"] ** updates),
            count=row,
        )
        self._center()

    def _center(self) -> None:
        """Subtract the mean over photographs and positions from the grids, at each level of luminance."""
        photographs, _, levels, rows, columns = self.shape
        self.device.program("color_grid_table.cl").color_grid_center(
            groups=ENTRIES * levels,
            values=self.arrays["values"],
            positions=rows * columns,
            photographs=photographs,
        )


def row_length(shape: Sequence[int]) -> int:
    """Return the number of values in the grid of one photograph.  shape: nx, ny, nz, in any order."""
    return ENTRIES * math.prod(shape)


def grid_bytes(shape: Sequence[int], photographs: int, rows: int) -> int:
    """Return the device memory of the grids, their Adam moments, and their gradients, in bytes.

    shape: nx, ny, nz; rows: number of pixel rows of the largest view, padded to full tiles.
    """
    row, columns = row_length(shape), ENTRIES * shape[0] * shape[2]
    return 4 * (len(TABLES) * photographs * row + 3 * row + columns * rows)
