"""Define the settings of `model.background`, which is rendered behind the Gaussians."""

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from clsplat.core.schedule import NonNegative
from clsplat.core.settings import Settings
from clsplat.gaussians.sky import SIDES


class Backdrop(Settings):
    """Base class of the settings of `model.background`."""

    @property
    def sky(self) -> "EnvironmentMap | None":
        """The settings of the learned sky, or None."""
        return None


class EnvironmentMap(Backdrop):
    """Learn a sky together with the Gaussians: a color for each direction, infinitely far away.

    A pixel has the color C + T b, where C is the blended color of the Gaussians, T their transmittance, and b the map's
    color in the direction of the pixel's ray.  The map is octahedral with bilinear interpolation, and has
    a separate Adam optimizer.  Texels in directions without sky in any photograph keep their initial color.  Where a
    photograph shows the map's color, a loss on alpha removes Gaussians in front of the sky (splatfacto-w, Xu et al.
    2024).
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"rate", "cover", "difference"})
    family: ClassVar[str] = "sky"

    type: Literal["envmap"] = "envmap"
    side: Annotated[int, Field(ge=SIDES[0], le=SIDES[1])] = 64
    """Number of texels along a side of the square map; with 64, they are 3 degrees apart."""
    rate: NonNegative = 5.0e-3
    """Learning rate of the colors; may be scheduled."""
    cover: NonNegative = 0.05
    """Weight of the loss on Gaussians in front of the sky, the mean alpha of sky pixels; may be scheduled."""
    difference: NonNegative = 0.05
    """Difference between pixel and map, averaged over channels, below which a pixel shows the sky; may be scheduled."""

    @property
    def sky(self) -> "EnvironmentMap":
        return self


class Auto(Backdrop):
    """Learn a sky if the photographs show one.

    Before training, the photographs are searched for sky: smooth, bright or blue regions that touch the upper edge and
    are far from all points of the dataset.  A photograph counts as one without sky if more than a quarter of these
    pixels are below the horizon.  If `auto` chooses no sky, the model is bit-identical to one without this key.
    """

    output_keys: ClassVar[frozenset[str]] = frozenset({"chosen", "reason"})

    type: Literal["auto"] = "auto"
    model: EnvironmentMap = EnvironmentMap()
    """The sky to learn."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.15
    """Fraction of the upper third of a photo that must be sky for the photo to count."""
    photographs: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Fraction of the photos that must count for a sky to be learned."""
    chosen: Literal["on", "off"] | None = None
    """Written by a run: whether a sky is learned."""
    reason: str = ""
    """Written by a run: the reason for the choice."""

    def active_values(self) -> dict[str, Any]:
        return {}  # conflicts are not errors: a run with a conflict chooses no sky

    @property
    def sky(self) -> EnvironmentMap | None:
        return self.model if self.chosen == "on" else None
