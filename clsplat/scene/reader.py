"""Define the base class of dataset readers, and the parts of a dataset that may be damaged."""

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from clsplat.core.errors import ConfigError, DataError
from clsplat.scene.lookup import FileLookup, Missing
from clsplat.scene.points import PointTable
from clsplat.scene.scene import Scene
from clsplat.scene.view import View

Result = TypeVar("Result")


@dataclass
class Parts:
    """The readable parts of a dataset; each damaged part is recorded as a fault.

    `scene` is None when the dataset cannot be read without faults; `refusal` is the reason why training cannot start.
    """

    path: Path
    kind: str = "none"
    views: list[View] = field(default_factory=list)  # views, even if their files do not exist
    models: dict[str, str] = field(default_factory=dict)  # camera model of each view, if the dataset names it
    observed: dict[str, int] = field(default_factory=dict)  # number of points that each view observes, if known
    submodels: dict[str, int] = field(default_factory=dict)  # image counts of COLMAP models, the one in use first
    points: PointTable | None = None
    image_folder: Path | None = None  # folder of all images; None: use only `expected_files`
    disk_files: list[Path] = field(default_factory=list)  # image files in the folders of the views
    expected_files: list[Path] = field(default_factory=list)  # files that the dataset names
    faults: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)  # warnings about files that `prepare` cannot read
    hint: str = ""  # hint at existing files that are similar to missing ones
    notes: list[str] = field(default_factory=list)  # notes about files that are not at the dataset's paths
    scene: Scene | None = None
    refusal: str = ""

    def attempt(self, function: Callable[..., Result], *arguments: Any) -> Result | None:
        """Call a function and return its result; when it raises DataError, record the fault and return None."""
        try:
            return function(*arguments)
        except DataError as error:
            if str(error) not in self.faults:
                self.faults.append(str(error))
            return None

    def expect(self, files: FileLookup) -> None:
        """Add the files that the dataset names to `expected_files`, and a note about inexact matches to `notes`."""
        self.expected_files += files.paths
        self.notes += [files.note] if files.note else []
        self.hint = files.hint
        if not all(path.is_relative_to(files.folder) for path in files.paths):
            self.image_folder = None


class Reader(ABC):
    """The base class of the readers of dataset formats.

    All commands use a subclass as soon as it is defined, unless it has subclasses itself.  A class that is defined
    again, as in a notebook, replaces the earlier one.
    """

    name: ClassVar[str]  # name of the format
    expects: ClassVar[str]  # the file that marks the format, or a short description for custom `matches`
    missing: Missing = "refuse"  # what to do about missing photographs
    root: Path | None = None  # folder of the scene, in which files are looked up; None: the folder of the dataset
    folder: Path = Path()  # folder of the dataset, at or below `root`
    choice: str = ""  # why this dataset is used, if there are several; for `note`
    subclasses: ClassVar[list[type["Reader"]]] = []  # every subclass, in the order of definition

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        name = (cls.__module__, cls.__qualname__)
        cls.subclasses[:] = [c for c in cls.subclasses if (c.__module__, c.__qualname__) != name] + [cls]

    def __init__(self) -> None:
        missing_attributes = [field for field in ("name", "expects") if not hasattr(self, field)]
        if missing_attributes:
            name = f"{type(self).__module__}.{type(self).__name__}"
            raise ConfigError(f"the reader {name} has no {' and no '.join(missing_attributes)}; add it to the class")

    @property
    def note(self) -> str:
        """One sentence that names the dataset in use; "" unless the dataset is in a subfolder of the scene."""
        if self.root in (None, self.folder):
            return ""
        return f"the {self.name} dataset in {self.folder.relative_to(self.root).as_posix()} is used{self.choice}"

    def matches(self, path: Path) -> bool:
        """Return whether a folder contains a dataset of this format.  By default, it must have the file `expects`."""
        return (path / self.expects).is_file()

    @abstractmethod
    def read(self, path: Path, holdout: int) -> Scene:
        """Return the scene in a folder; every `holdout`-th view is a test view if the dataset has no split.

        Raises DataError when a file is missing, damaged or not supported.
        """

    def list_parts(self, parts: Parts) -> None:
        """Add the readable parts of a possibly damaged dataset to `parts`; by default, those of `parts.scene`."""
        scene = parts.scene
        if scene is not None:
            parts.views = list(scene.views)
            parts.expected_files = [view.image_path for view in scene.views]
        if scene is not None and scene.points is not None:
            rgb = np.rint(scene.points.colors * 255)
            parts.points = PointTable(parts.path, scene.points.positions, rgb)


def reader_classes() -> list[type[Reader]]:
    """Return the reader classes that are not abstract and have no subclasses, in the order of their definition."""
    bases = {base for cls in Reader.subclasses for base in cls.__mro__[1:]}
    return [cls for cls in Reader.subclasses if cls not in bases and not inspect.isabstract(cls)]
