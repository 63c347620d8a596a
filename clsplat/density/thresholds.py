"""Define the thresholds of density rules, which are scheduled values or quantiles, and their units."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import NonNegative, explain_schedule
from clsplat.core.settings import Settings

UnitInterval = Annotated[float, Field(ge=0, le=1)]


class Quantile(Settings):
    """The quantile of a statistic over the Gaussians."""

    quantile: UnitInterval
    """Fraction of the Gaussians that are below the threshold."""
    of: Literal["gaussians"] = "gaussians"
    """Take the quantile over the Gaussians."""


class PixelQuantile(Settings):
    """A quantile of the texture over the pixels of the training photographs.  Its unit is 1 / px."""

    quantile: UnitInterval
    """Fraction of the pixels that are below the threshold."""
    of: Literal["pixels"]
    """Take the quantile over the photos' pixels."""


Threshold = Annotated[Quantile | PixelQuantile | NonNegative, explain_schedule(", or {quantile, of}")]


def _raise_no_photographs(q: float) -> float:
    raise ConfigError("a quantile of pixels needs training photos, but there are none; use a number")


@dataclass(frozen=True)
class SceneScale:
    """The properties of the scene to which thresholds of rules are relative."""

    extent: float  # scene units
    texture_quantile: Callable[[float], float] = _raise_no_photographs  # quantile -> texture of the photographs, per px
