"""The base class of all dataset readers."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np

from clsplat.errors import ConfigError
from clsplat.scene.parts import Parts
from clsplat.scene.points import PointTable
from clsplat.scene.scene import Scene


class Reader(ABC):
    """A dataset format.

    All commands use a subclass as soon as it is defined; they do not use a class that has subclasses of its own.
    """

    name: ClassVar[str]  # of the format
    expects: ClassVar[str]  # the files that mark the format, in a few words

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
            rgb = np.rint(scene.points.colours * 255)
            parts.points = PointTable(parts.path, scene.points.positions, rgb)


def reader_classes(base: type[Reader] = Reader) -> Iterator[type[Reader]]:
    """Yield the classes below `base` that have no subclasses and are not abstract, in the order of their definition."""
    for found in base.__subclasses__():
        if found.__subclasses__():
            yield from reader_classes(found)
        elif not inspect.isabstract(found):
            yield found
