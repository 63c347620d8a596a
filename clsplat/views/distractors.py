"""What each photograph has before the scene: people, cars and whatever else no other photograph shows there."""

from typing import Annotated, ClassVar

from pydantic import Field

from clsplat.schedule import NonNegative
from clsplat.settings import Settings


class Distractors(Settings):
    """Give each photograph Gaussians of its own, just before its camera (DeSplat, Wang et al. 2024).

    They take up what the scene does not have, and are in no other picture, no measurement and no file.  Their number
    stays.  Those that cover more than they explain fade.
    """

    training_keys: ClassVar[frozenset[str]] = frozenset({"start", "cover"})
    step_keys: ClassVar[frozenset[str]] = frozenset({"start"})

    count: Annotated[int, Field(gt=0, le=10_000)] = 200
    """Number of them for each photograph."""
    start: Annotated[int, Field(ge=0)] = 0
    """Global step after which they are there."""
    cover: NonNegative = 0.1
    """Weight of the mean of what they cover of a photograph, from 0 to 1, among the losses; by step."""
