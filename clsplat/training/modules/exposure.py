"""The colours of the photographs while a model is trained: between the rendered image and the losses."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.core.errors import DataError
from clsplat.core.schedule import Schedule, at_step
from clsplat.core.settings import OneOf
from clsplat.opencl.device import Array, Device, constants
from clsplat.photos.appearance import (
    ENTRIES,
    GRID_NAMES,
    IDENTITY,
    LUMINANCE,
    MEANING,
    TABLE,
    Colours,
    Floats,
    GridTables,
    OwnColours,
    Tables,
    ViewColours,
    ViewTable,
    Written,
    fitted_gains,
)
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace
from clsplat.scene.view import View

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


# What makes the colours of a scene those of one photograph, and how a pipeline file names it.

SPREAD = 0.03  # of the exposures: smaller ones are within what tracks measure
# Of the differences: 17 to 31 % in three captures as they are, 40 to 71 % in the same with exposures changed by 25 %.
EXPLAINED = 1 / 3


class Gain(ColourModel):
    """An exposure and a white balance of each photograph.

    Channels are multiplied by exp(exposure + (red, green, blue)); green follows from red and blue, so that the
    luminance follows the exposure alone.
    """

    columns: ClassVar[tuple[str, ...]] = ("exposure", "red", "blue")

    type: Literal["gain"] = "gain"

    def matrix(self, row: Floats) -> Floats:
        exposure, red, blue = row
        green = -(LUMINANCE[0] * red + LUMINANCE[2] * blue) / LUMINANCE[1]
        return np.column_stack([np.diag(np.exp(exposure + np.array([red, green, blue]))), np.zeros(3)])

    def gradient(self, row: Floats, by_matrix: Floats) -> Floats:
        red, green, blue = np.diag(by_matrix) * np.diag(self.matrix(row))
        tied = green * LUMINANCE / LUMINANCE[1]
        return np.array([red + green + blue, red - tied[0], blue - tied[2]])

    def of_gains(self, log_gains: Floats) -> Floats:
        exposure = LUMINANCE @ log_gains
        return np.array([exposure, log_gains[0] - exposure, log_gains[2] - exposure])

    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        return fitted_gains(image, photograph)


class Affine(ColourModel):
    """An affine change of the colours of each photograph, twelve numbers (Kerbl et al. 2024).

    It follows white balance, contrast and haze, and also what is none of these: colours that change with the direction
    of view, which it takes from the Gaussians; `weight` holds it back.  `gain` generalises better.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})
    columns: ClassVar[tuple[str, ...]] = tuple(f"{y}_{c}" for y in ("red", "green", "blue") for c in "rgb1")
    fitted_to_a_channel: ClassVar[int] = 4

    type: Literal["affine"] = "affine"
    weight: Annotated[float, Field(ge=0)] = 1e-2
    """Factor of the loss that pulls the matrix of the photograph of a step to that of no change: the sum of the squared
    differences, without the constants."""

    def matrix(self, row: Floats) -> Floats:
        return IDENTITY + row.reshape(3, 4)

    def gradient(self, row: Floats, by_matrix: Floats) -> Floats:
        return by_matrix.ravel()

    def of_gains(self, log_gains: Floats) -> Floats:
        return (np.column_stack([np.diag(np.exp(log_gains)), np.zeros(3)]) - IDENTITY).ravel()

    def penalty(self, row: Floats) -> tuple[float, Floats]:
        away = row.reshape(3, 4) * [1, 1, 1, 0]
        return self.weight * float((away**2).sum()), 2 * self.weight * away.ravel()

    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        if len(image) == 0:
            return IDENTITY
        with_one = np.column_stack([image, np.ones(len(image))])
        squares = np.einsum("mi,mj->ij", with_one, with_one)  # no sum depends on threads
        products = np.einsum("mi,mj->ij", with_one, photograph)
        return np.asarray(np.linalg.lstsq(squares, products, rcond=None)[0].T, np.float64)


class Auto(Colours):
    """Colours of each photograph where exposures differ, by what the photographs show of the same points.

    The logarithms of the exposures are measured on the tracks of the dataset's points, before training.  Photographs
    have colours of their own where two bounds are passed: the standard deviation of the exposures, and their share of
    what differs between photographs of one point; light that changes with the direction of view is the rest.  Elsewhere
    the bits are those without this key.
    """

    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "reason"})

    type: Literal["auto"] = "auto"
    model: OneOf[OwnColours] = Gain()
    """What photographs have, where exposures differ."""
    above: Annotated[float, Field(ge=0)] = SPREAD
    """Standard deviation of the logarithms of the exposures above which they do; 0.03 is 3 %."""
    explained: Annotated[float, Field(ge=0, lt=1)] = EXPLAINED
    """Share of the differences above which they do."""
    chosen: Literal["on", "off"] | None = None
    """Written by a run: whether photographs have colours of their own."""
    reason: str = ""
    """Written by a run: why."""

    @property
    def files(self) -> tuple[str, ...]:
        return self.model.files

    @property
    def in_use(self) -> OwnColours | None:
        """What photographs have, once it is chosen."""
        return self.model if self.chosen == "on" else None

    def choose(self, chosen: Literal["on", "off"], reason: str) -> "Auto":
        """Return it with a choice."""
        return self.model_copy(update={"chosen": chosen, "reason": reason})


# The grids of the photographs in a run: their tables in a checkpoint, and their memory on the device.

FOLDER = "colour_grids/"  # before the names of their tables in a checkpoint


def check_tables(tables: Tables) -> None:
    """Raise DataError for tables that are not those of grids; there may be none, or the values alone."""
    if not tables:
        return
    if tables.keys() not in (set(GRID_NAMES), {GRID_NAMES[0]}):
        raise DataError("it has other grids than those of its own tables")
    shape = tables[GRID_NAMES[0]].shape
    for name, table in tables.items():
        is_one = table.dtype == np.float32 and table.shape == shape and len(shape) == 5 and 0 not in shape
        if not is_one or shape[1] != ENTRIES:
            raise DataError(f"{name} of its grids is not [photographs, {ENTRIES}, nz, ny, nx] of float32")
        if not np.isfinite(table).all():
            raise DataError(f"{name} of its grids holds values that are not finite")


def require_tables(tables: Tables, numbers: Mapping[str, float]) -> None:
    """Raise DataError where the rows that the numbers of a run name are not those of its grids."""
    named = sorted(row for key, row in numbers.items() if key.startswith(f"{TABLE}/") and key.endswith("/row"))
    held = len(tables[GRID_NAMES[0]]) if tables else 0
    if named != list(range(held)):
        raise DataError(f"it has grids of the colours of {held} photographs, and its numbers name {len(named)} rows")


def restored(tables: Tables, device: Device) -> GridTables | None:
    """Return the grids of a checkpoint's tables, by their own names; None without any."""
    if not tables:
        return None
    photographs, _, *cells = tables[GRID_NAMES[0]].shape
    found = GridTables(device, photographs, cells[::-1])
    found.set(tables)
    return found


def bytes_needed(settings: Any, views: Sequence[View], tile: int) -> int:
    """Return what the colours of a pipeline's trainings take on the device, at most.  tile: px of its sides."""
    kinds = [getattr(stage, "colours", None) for stage in getattr(settings, "stages", ())]
    models = [kind.model if isinstance(kind, Auto) and kind.chosen != "off" else kind for kind in kinds]
    sides = [(-(-view.camera.width // tile) * tile, -(-view.camera.height // tile) * tile) for view in views]
    rows, pixels = max(height for _, height in sides), max(width * height for width, height in sides)
    photographs = len({view.name for view in views})
    own = [one for one in models if isinstance(one, OwnColours)]
    return max((one.device_bytes(photographs, rows, pixels) for one in own), default=0)
