"""What a key `colours` of a pipeline file takes, and what each kind of colours of photographs tells of itself."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator

from clsplat.core.files import VIEW_COLOURS
from clsplat.core.schedule import Bounded, Decay, Schedule, explained
from clsplat.core.settings import Settings
from clsplat.opencl.device import Array, Device, constants
from clsplat.render.camera import DeviceCamera
from clsplat.render.workspace import Workspace

# The tables of the colour grids of all photographs on the device.

ENTRIES = int(constants("colour_grid.h")["ENTRIES"])
GRID_NAMES = ("values", "moment1", "moment2")
Tables = dict[str, NDArray[np.float32]]


class GridTables:
    """The grids of all photographs on the device, with Adam's moments: each [photographs, ENTRIES, nz, ny, nx]."""

    def __init__(self, device: Device, photographs: int, cells: Sequence[int]) -> None:
        """The values are differences from no change, 0 at first.  cells: nx, ny, nz."""
        self.device, self.shape = device, (photographs, ENTRIES, *reversed(cells))
        self.arrays: dict[str, Array] = {name: device.zeros(self.shape) for name in GRID_NAMES}

    def fit(self, photographs: int, cells: Sequence[int]) -> bool:
        """Whether they are of so many photographs and of these cells, nx, ny, nz."""
        return self.shape == (photographs, ENTRIES, *reversed(cells))

    def set(self, tables: Mapping[str, NDArray[np.float32]]) -> None:
        """Take tables of a checkpoint; those that it does not have become 0."""
        for name, array in self.arrays.items():
            array.set(np.ascontiguousarray(tables.get(name, np.zeros(self.shape, np.float32))))

    def tables(self, names: Sequence[str] = GRID_NAMES) -> Tables:
        """Copy tables to the host."""
        return {name: self.arrays[name].get() for name in names}

    def centre(self) -> None:
        """Subtract the mean over photographs and places at each level of luminance."""
        photographs, _, levels, rows, columns = self.shape
        self.device.program("colour_grid_table.cl").colour_grid_centre(
            groups=ENTRIES * levels,
            values=self.arrays["values"],
            places=rows * columns,
            photographs=photographs,
        )


def row_length(cells: Sequence[int]) -> int:
    """Return the values of one photograph."""
    return ENTRIES * math.prod(cells)


def bytes_of(cells: Sequence[int], photographs: int, rows: int, pixels: int) -> int:
    """Return what grids take on the device.  rows, pixels: of the largest view, whole tiles."""
    row, columns = row_length(cells), ENTRIES * cells[0] * cells[2]
    return 4 * (len(GRID_NAMES) * photographs * row + 3 * row + columns * rows + 3 * pixels)


# What a training has of the colours of its photographs, of whichever kind they are.

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


FEW_VISITS = 400  # of a photograph: with fewer, Adam at 2e-3 cannot reach a gain of 1.5
MOST = 5e-2  # learning rate
Rate = Annotated[Schedule, AfterValidator(Bounded(0, most=0.5))]  # Adam's steps are as long: a gain of 1.6 in each
RateOrAuto = Annotated[Literal["auto"] | Rate, explained(", or auto")]


class Colours(Settings):
    """Colours of each photograph: what a key `colours` takes."""

    @property
    def files(self) -> tuple[str, ...]:
        """The names of what a training writes of them into the run folder."""
        return (VIEW_COLOURS,)


class OwnColours(Colours):
    """Numbers of each photograph, which are learned with the Gaussians; their mean over the photographs stays 0.

    Without that, a change of all of them and the opposite one of the Gaussians would be the same to every loss, and the
    colours of the model would drift.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate"})
    columns: ClassVar[tuple[str, ...]] = ()  # names of what the numbers of a run have for each photograph
    fitted_to_a_channel: ClassVar[int] = 1  # numbers that `fitted` finds for each of red, green and blue

    rate: RateOrAuto = "auto"
    """Learning rate of the numbers, by Adam, by step; auto: 1e-2 to 1e-3, where each photograph is visited 400 times or
    more 2e-3 to 2e-5; where no tracks tell the exposures, as large as a gain of 2.7 needs, up to 5e-2.  At most 0.5."""

    def rate_of(self, steps: int, photographs: int, known: bool = True) -> Schedule:
        """Return the learning rate by step of a training with so many steps and photographs.

        known: whether the numbers begin near those of the photographs.
        """
        if self.rate != "auto":
            return self.rate
        visits = steps / photographs
        initial, final = (1e-2, 1e-3) if visits < FEW_VISITS else (2e-3, 2e-5)
        if not known:
            needed = min(math.log(10) / (0.9 * visits), MOST)  # the sum of rates that fall to a tenth is 1
            initial, final = max(initial, needed), max(final, needed / 10)
        return Decay(initial=initial, final=final, over=steps)

    @abstractmethod
    def of_views(self, views: Sequence[str], device: Device, tables: GridTables | None) -> ViewColours:
        """Return what a training has of them.

        views: the names of the training views, by number; tables: those that the run has on the device, if any, which
        go on where they are of these photographs and of this size.
        """

    def device_bytes(self, photographs: int, rows: int, pixels: int) -> int:
        """Return what they take on the device beside planes of pixels.  rows, pixels: of the largest view, whole
        tiles."""
        return 0

    @abstractmethod
    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        """Return the matrix, [3, 4], that brings an image nearest to a photograph by least squares, pixels [M, 3]."""


def fitted_gains(image: Floats, photograph: Floats) -> Floats:
    """Return the matrix, [3, 4], of the gains of red, green and blue that bring an image nearest to a photograph.

    By least squares; both are pixels, [M, 3].
    """
    squares, products = (image * image).sum(axis=0), (image * photograph).sum(axis=0)
    gains = np.where((squares > 0) & (products > 0), products / np.where(squares > 0, squares, 1), 1.0)
    return np.column_stack([np.diag(gains), np.zeros(3)])


# Adam on numbers by name, which lie in one dictionary with their moments, as a run keeps it in its checkpoints.

ADAM = constants("adam.h")
ByNumber = dict[str, float]


def adam_step(numbers: dict[str, float], values: Mapping[str, float], gradients: ByNumber, rate: float) -> None:
    """Change some numbers by Adam (Kingma and Ba 2015), as the parameters of the Gaussians are changed.

    values: the numbers now, by name; beside each, `numbers` keeps NAME/updates, NAME/moment1 and NAME/moment2.
    """
    beta1, beta2 = ADAM["BETA1"], ADAM["BETA2"]
    for name, value in values.items():
        names = [f"{name}/{kept}" for kept in ("updates", "moment1", "moment2")]
        updates, moment1, moment2 = (numbers.get(kept, 0.0) for kept in names)
        updates, gradient = updates + 1, gradients[name]
        moment1 = beta1 * moment1 + (1 - beta1) * gradient
        moment2 = beta2 * moment2 + (1 - beta2) * gradient**2
        root = math.sqrt(moment2 / (1 - beta2**updates)) + ADAM["EPSILON"]
        numbers[name] = value - rate * moment1 / (1 - beta1**updates) / root
        numbers |= dict(zip(names, (updates, moment1, moment2), strict=True))


# A table of numbers with a row for each photograph, and Adam of its own: a step changes the row of its photograph.


@dataclass(frozen=True)
class ViewTable:
    """The names of a table, of its rows, and of its columns; each number is 0 before the first step."""

    name: str
    views: tuple[str, ...]  # names of the training views, each once
    columns: tuple[str, ...]

    def keys(self, view: str) -> list[str]:
        """Return the names of a row's numbers."""
        return [f"{self.name}/{view}/{column}" for column in self.columns]

    def row(self, numbers: Mapping[str, float], view: str) -> Floats:
        """Return a row, [columns]."""
        return np.array([numbers.get(key, 0.0) for key in self.keys(view)])

    def begun(self, numbers: Mapping[str, float]) -> bool:
        """Whether the dictionary holds the table."""
        return self.keys(self.views[0])[0] in numbers

    def begin(self, numbers: dict[str, float], rows: Mapping[str, Floats]) -> None:
        """Set every row, to 0 where none is given, then `centre`."""
        for view in self.views:
            values = rows.get(view, np.zeros(len(self.columns)))
            numbers.update(zip(self.keys(view), map(float, values), strict=True))
        self.centre(numbers)

    def update(self, numbers: dict[str, float], view: str, gradient: Floats, rate: float) -> None:
        """Change the row of a view by Adam, with a count of updates of its own, then `centre`."""
        values = {key: numbers[key] for key in self.keys(view)}
        adam_step(numbers, values, dict(zip(values, map(float, gradient), strict=True)), rate)
        self.centre(numbers)

    def centre(self, numbers: dict[str, float]) -> None:
        """Subtract from each column its mean over the views; the sum is exact, so that no order matters."""
        for column in zip(*map(self.keys, self.views), strict=True):
            mean = math.fsum(numbers[key] for key in column) / len(column)
            for key in column:
                numbers[key] -= mean
