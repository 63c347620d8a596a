"""What a key `colours` of a pipeline file takes, and what each kind of colours of photographs tells of itself."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator

from clsplat.names import VIEW_COLOURS
from clsplat.opencl.device import Device
from clsplat.schedule import Bounded, Decay, Schedule, explained
from clsplat.settings import Settings
from clsplat.views.grid_tables import GridTables
from clsplat.views.view_colours import Floats, ViewColours

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
