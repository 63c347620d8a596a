"""Thresholds of density rules: a number, or a quantile of what the scene itself shows."""

from typing import Annotated, Literal

from pydantic import Field

from clsplat.settings import Settings

Share = Annotated[float, Field(ge=0, le=1)]


class Quantile(Settings):
    """What a share of the Gaussians' own values, as they are, stay below."""

    quantile: Share
    of: Literal["gaussians"] = "gaussians"


class PixelQuantile(Settings):
    """The texture that a share of the training photographs' pixels stay below."""

    quantile: Share
    of: Literal["pixels"]


Threshold = Annotated[float, Field(ge=0)] | Quantile | PixelQuantile
