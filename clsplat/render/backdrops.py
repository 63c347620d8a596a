"""What is behind the Gaussians, as `model.background` in a pipeline file says."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from clsplat.core.schedule import NonNegative
from clsplat.core.settings import Settings
from clsplat.gaussians.sky import SIDES


class Backdrop(Settings):
    """What a key `background` of `model` takes."""


class Directions(Backdrop):
    """A color for each direction, learned with the Gaussians: the sky, which no point is near.

    A pixel has the color C + T b: b in the direction of its ray, T what the Gaussians leave.  Colors are those of an
    octahedral map, bilinear, with Adam of its own; in directions in which photographs show no sky they stay
    as they begin.
    Where a photograph shows the map's color, Gaussians have a loss of what they cover there (splatfacto-w, Xu et al.
    2024), so that they leave the sky.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "cover", "difference"})
    family: ClassVar[str] = "sky"

    type: Literal["directions"] = "directions"
    side: Annotated[int, Field(ge=SIDES[0], le=SIDES[1])] = 64
    """Texels in a row of the map, which is square; 64 are 3 degrees from one to the next."""
    rate: NonNegative = 5.0e-3
    """Learning rate of the colors, by Adam, by step."""
    cover: NonNegative = 0.05
    """Factor of the loss of what covers the sky: the mean over the image of alpha in pixels that show it; by step."""
    difference: NonNegative = 0.05
    """Difference of the colors, the mean of the channels, up to which a pixel of a photograph shows the map."""


class Auto(Backdrop):
    """A sky where photographs have one, by what their upper part shows.

    Before training the photographs are looked at: pixels show the sky that are bright or blue, far from all points of
    the dataset, even, and joined to the upper edge.  A photograph with more than a quarter of them below the horizon
    shows none.  Elsewhere the bits are those without this key.
    """

    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "reason"})

    type: Literal["auto"] = "auto"
    model: Directions = Directions()
    """What is behind the Gaussians, where photographs show a sky."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.15
    """Share of the upper third of a photograph from which on it shows one."""
    photographs: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the photographs that must."""
    chosen: Literal["on", "off"] | None = None
    """Written by a run: whether there is a sky."""
    reason: str = ""
    """Written by a run: why."""

    def parts(self) -> dict[str, Any]:
        return {}  # a run leaves the sky out where something excludes it

    @property
    def in_use(self) -> Directions | None:
        """What is behind the Gaussians, once it is chosen."""
        return self.model if self.chosen == "on" else None
