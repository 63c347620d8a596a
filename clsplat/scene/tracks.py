"""Which points of a dataset each photograph shows: what structure from motion has found."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Tracks:
    """Points, and the photographs that show them."""

    positions: NDArray[np.floating]  # [M, 3], scene units
    seen: Mapping[str, NDArray[np.int64]]  # rows of `positions`, ascending by id of the point, by the name of a view
