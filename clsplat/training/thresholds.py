"""Thresholds of density rules: a number, or a quantile of what the scene itself shows."""

from typing import Annotated, Literal

from pydantic import Field

from clsplat.settings import Settings

Share = Annotated[float, Field(ge=0, le=1)]


class Quantile(Settings):
    """What a share of all values stay below: of the training photographs' pixels, or of the Gaussians as they are."""

    quantile: Share
    of: Literal["pixels", "gaussians"] = "gaussians"


Threshold = Annotated[float, Field(ge=0)] | Quantile
