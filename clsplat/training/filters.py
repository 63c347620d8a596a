"""What a pipeline's `model:` says: the degree of the colours and the two low-pass filters, as numbers."""

from typing import Annotated, Literal

from pydantic import Field

from clsplat.gaussians.model import Gaussians, Model
from clsplat.settings import Settings


class NoWorldFilter(Settings):
    """Gaussians keep their own size."""

    type: Literal["none"] = "none"


class Dilation(Settings):
    """Add a variance to every splat on the screen, so that none is thinner than a pixel (Kerbl et al. 2023)."""

    type: Literal["dilation"] = "dilation"
    variance: Annotated[float, Field(ge=0)] = 0.3  # px²
    compensate: Literal[0, 1] = 0  # 1: opacity loses what the filter spreads out


WORLD_FILTERS = {"none": NoWorldFilter}
SCREEN_FILTERS = {"dilation": Dilation}


class ModelSettings(Settings):
    """How Gaussians are rendered."""

    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    near: Annotated[float, Field(gt=0)] = 0.2  # scene units; nearer Gaussians are not drawn
    world_filter: NoWorldFilter = NoWorldFilter()
    screen_filter: Dilation = Dilation()

    def model(self, gaussians: Gaussians, degree: int) -> Model:
        """Return the Gaussians with the numbers of these settings; `degree` is the active one."""
        screen = self.screen_filter
        return Model(gaussians, degree, self.near, screen.variance, float(screen.compensate))
