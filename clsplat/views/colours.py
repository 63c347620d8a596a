"""What makes the colours of a scene those of one photograph, and how a pipeline file names it.

A photograph has its numbers, all 0 where its colours are the scene's.  They make a matrix [E | b], or a grid of such
matrices, and a pixel c of the rendered image becomes min(1, E c + b) before every loss (cl_kernels/colours.cl).
"""

import math
from abc import abstractmethod
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from clsplat.names import VIEW_COLOURS, VIEW_GRIDS
from clsplat.schedule import Bounded, Decay, Points, Schedule, at_step, explained
from clsplat.settings import OneOf, Settings

Floats = NDArray[np.float64]
LUMINANCE = np.array([0.299, 0.587, 0.114])  # BT.601
IDENTITY = np.eye(3, 4)
FEW_VISITS = 400  # of a photograph: with fewer, Adam at 2e-3 cannot reach a gain of 1.5
MOST = 5e-2  # learning rate
Rate = Annotated[Schedule, AfterValidator(Bounded(0, most=0.5))]  # Adam's steps are as long: a gain of 1.6 in each
WARM_UP = 1000  # steps in which the rate of grids grows from 1 % of itself (gsplat); a tenth of shorter trainings
Nodes = Annotated[int, Field(ge=1, le=16)]  # MOST_NODES of colour_grid.cl
RateOrAuto = Annotated[Literal["auto"] | Rate, explained(", or auto")]
SPREAD = 0.03  # of the exposures: smaller ones are within what tracks measure
# Of the differences: 17 to 31 % in three captures as they are, 40 to 71 % in the same with exposures changed by 25 %.
EXPLAINED = 1 / 3


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
    columns: ClassVar[tuple[str, ...]]  # names of what the numbers of a run have for each photograph

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
    def fitted(self, image: Floats, photograph: Floats) -> Floats:
        """Return the matrix, [3, 4], that brings an image nearest to a photograph by least squares, pixels [M, 3]."""


class ColourModel(OwnColours):
    """Colours of which a photograph has one matrix for all its pixels."""

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
        squares, products = (image * image).sum(axis=0), (image * photograph).sum(axis=0)
        gains = np.where((squares > 0) & (products > 0), products / np.where(squares > 0, squares, 1), 1.0)
        return np.column_stack([np.diag(gains), np.zeros(3)])


class Affine(ColourModel):
    """An affine change of the colours of each photograph, twelve numbers (Kerbl et al. 2024).

    It follows white balance, contrast and haze, and also what is none of these: colours that change with the direction
    of view, which it takes from the Gaussians; `weight` holds it back.  `gain` generalises better.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"weight"})
    columns: ClassVar[tuple[str, ...]] = tuple(f"{y}_{c}" for y in ("red", "green", "blue") for c in "rgb1")

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
        return Gain().fitted(image, photograph)


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
