"""The base class of all dataset readers."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from clsplat.core.errors import ConfigError, DataError
from clsplat.scene.images import Missing
from clsplat.scene.points import PointTable
from clsplat.scene.scene import Scene
from clsplat.scene.view import View

# A dataset in pieces: a damaged piece becomes a fault, and the other pieces stay readable.

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


class Reader(ABC):
    """A dataset format.

    All commands use a subclass as soon as it is defined; they do not use a class that has subclasses of its own.  A
    class that is defined again, as in a notebook, replaces the one before.
    """

    name: ClassVar[str]  # of the format
    expects: ClassVar[str]  # the files that mark the format, in a few words
    missing: Missing = "refuse"  # what to do about photographs that the dataset names and does not have
    defined: ClassVar[list[type["Reader"]]] = []  # every subclass, in the order of definition

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        place = (cls.__module__, cls.__qualname__)
        Reader.defined[:] = [kind for kind in Reader.defined if (kind.__module__, kind.__qualname__) != place] + [cls]

    def __init__(self) -> None:
        missing = [field for field in ("name", "expects") if not hasattr(self, field)]
        if missing:
            kind = f"{type(self).__module__}.{type(self).__name__}"
            raise ConfigError(f"the reader {kind} has no {' and no '.join(missing)}; add it to the class")

    @abstractmethod
    def matches(self, path: Path) -> bool:
        """Return whether a folder holds a dataset of this format, without reading it."""

    @abstractmethod
    def read(self, path: Path, holdout: int) -> Scene:
        """Read the dataset in a folder; every `holdout`-th view is for testing where the dataset has no split.

        Raises DataError when a file is missing, damaged or not supported.
        """

    def list_parts(self, parts: Parts) -> None:
        """Add the readable pieces of a dataset, which may be damaged; by default those that `read` returned."""
        scene = parts.scene
        if scene is not None:
            parts.views = list(scene.views)
            parts.expected = [view.image_path for view in scene.views]
        if scene is not None and scene.points is not None:
            rgb = np.rint(scene.points.colors * 255)
            parts.points = PointTable(parts.path, scene.points.positions, rgb)


def reader_classes() -> list[type[Reader]]:
    """Return the classes that have no subclasses and are not abstract, in the order of their definition."""
    bases = {base for kind in Reader.defined for base in kind.__mro__[1:]}
    return [kind for kind in Reader.defined if kind not in bases and not inspect.isabstract(kind)]
