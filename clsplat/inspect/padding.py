"""Edges of photographs that repeat the pixels beside them: what an undistortion fills."""

from collections.abc import Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import DataError
from clsplat.scene.images import read_grey

EDGES = ("left", "top", "right", "bottom")  # as np.rot90 turns them to the left
EXAMPLES = 3  # photographs: all of a dataset are filled alike
WIDEST = 32  # px
REPEATED, DIFFERENT = 0.5, 2.0  # mean grey levels between neighbouring lines: without loss, and of a sharp photograph
VARIED = 8.0  # grey levels: the standard deviation along a line that is more than plain
FULL = 1 << 30  # px: no photograph is longer


def padding(files: Iterable[Path]) -> dict[str, int]:
    """Return how many px of an edge repeat the line beside them in each of the first photographs, by edge.

    It is WIDEST at most.  Lines of one colour say nothing, nor do photographs that are alike or enlarged everywhere.
    JPEG hides it.
    """
    found: list[list[int]] = []
    with suppress(DataError):  # what cannot be read is another finding
        found = [filled(read_grey(file, FULL)[0]) for file in islice(files, EXAMPLES)]
    least = np.min(found, axis=0).tolist() if found else []
    return {edge: px for edge, px in zip(EDGES, least, strict=False) if px}


def filled(grey: NDArray[np.uint8]) -> list[int]:
    """Return how many px of each edge of a photograph [H, W] repeat the line beside them, in the order of EDGES."""
    return [_repeats(np.rot90(grey, turns)[:, : WIDEST + 3].astype(np.float32)) for turns in range(len(EDGES))]


def _repeats(lines: NDArray[np.float32]) -> int:
    """How many columns at the left repeat the next one."""
    changes = np.abs(np.diff(lines, axis=1)).mean(axis=0)
    count = int(np.argmax(np.append(changes, np.inf) >= REPEATED))
    beyond = changes[count : count + 2]  # where a photograph is enlarged, lines repeat here too
    ends = len(beyond) == 2 and beyond[0] >= DIFFERENT and beyond[1] >= REPEATED
    return count if ends and lines[:, 0].std() > VARIED else 0
