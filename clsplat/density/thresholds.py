"""Thresholds of density rules: a number by step, or a quantile of what the scene itself shows."""

from typing import Annotated, Literal

from pydantic import Field

from clsplat.schedule import NonNegative, explained
from clsplat.settings import Settings

Share = Annotated[float, Field(ge=0, le=1)]


class Quantile(Settings):
    """The value that a share of the Gaussians stay below."""

    quantile: Share
    """Share of the Gaussians."""
    of: Literal["gaussians"] = "gaussians"
    """The Gaussians' own values."""


class PixelQuantile(Settings):
    """The texture that a share of the training photographs' pixels stay below."""

    quantile: Share
    """Share of the pixels."""
    of: Literal["pixels"]
    """The photographs' pixels."""


Threshold = Annotated[Quantile | PixelQuantile | NonNegative, explained(", or {quantile, of}")]
