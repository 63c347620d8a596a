"""A dataset in pieces: a damaged piece becomes a fault, and the other pieces stay readable."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from clsplat.errors import DataError
from clsplat.scene.points import PointTable
from clsplat.scene.scene import Scene, View

Result = TypeVar("Result")


@dataclass
class Parts:
    """A dataset in pieces.

    `scene` is None when the dataset cannot be read as a whole; `refusal` is the reason why training does not start.
    """

    path: Path
    kind: str = "none"
    views: list[View] = field(default_factory=list)  # whether or not their files exist
    models: dict[str, str] = field(default_factory=dict)  # camera models by view, where the dataset names them
    observed: dict[str, int] = field(default_factory=dict)  # points seen, by view, where the dataset has them
    submodels: dict[str, int] = field(default_factory=dict)  # images of each COLMAP model, the one that is used first
    points: PointTable | None = None
    image_folder: Path | None = None  # holds all images of the dataset; None: the folders of `expected`
    on_disk: list[Path] = field(default_factory=list)  # image files where the views' files are looked for
    expected: list[Path] = field(default_factory=list)  # files that the dataset names
    faults: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # what is told of files that are no photographs for `prepare`
    scene: Scene | None = None
    refusal: str = ""
    _said: set[str] = field(default_factory=set)  # of `faults`

    def attempt(self, read: Callable[..., Result], *arguments: Any) -> Result | None:
        """Return what a function reads; where it raises DataError, note the fault and return None."""
        try:
            return read(*arguments)
        except DataError as error:
            if str(error) not in self._said:
                self._said.add(str(error))
                self.faults.append(str(error))
            return None
