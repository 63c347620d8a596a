"""What makes the colours of a scene those of one photograph, and how a pipeline file names it.

A photograph has its numbers, all 0 where its colours are the scene's.  They make a matrix [E | b], or a grid of such
matrices, and a pixel c of the rendered image becomes min(1, E c + b) before every loss (cl_kernels/colours.cl).
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from clsplat.settings import OneOf
from clsplat.views.own_colours import Colours as Colours
from clsplat.views.own_colours import OwnColours as OwnColours
from clsplat.views.own_colours import fitted_gains
from clsplat.views.photograph_colours import ColourModel as ColourModel
from clsplat.views.photograph_grids import Grid as Grid
from clsplat.views.view_colours import IDENTITY as IDENTITY
from clsplat.views.view_colours import LUMINANCE as LUMINANCE
from clsplat.views.view_colours import Floats as Floats

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
