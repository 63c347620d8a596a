"""Find the reader of a dataset among shipped readers and those of plug-ins."""

from pathlib import Path

from clsplat.core.errors import ConfigError, DataError, shell_quote
from clsplat.formats.table import detect as model_format
from clsplat.scene.colmap import ColmapReader
from clsplat.scene.images import is_image
from clsplat.scene.llff import LlffReader
from clsplat.scene.multicamera import MulticameraReader
from clsplat.scene.reader import Reader, reader_classes
from clsplat.scene.scene import HOLDOUT, Scene
from clsplat.scene.transforms_json import BlenderReader, MultiscaleReader, NerfstudioReader
from clsplat.scene.view_selection import Split

PRECEDENCE = (MulticameraReader, ColmapReader, BlenderReader, MultiscaleReader, NerfstudioReader, LlffReader)


def readers() -> list[Reader]:
    """Return the readers in order of precedence: shipped ones, then those of plug-ins in order of definition.

    Raises ConfigError if two have the same name, or one has none.
    """

    def rank(kind: type[Reader]) -> int:
        """Return the rank of a shipped reader, or of the one that the class extends."""
        return next((i for i, shipped in enumerate(PRECEDENCE) if issubclass(kind, shipped)), len(PRECEDENCE))

    by_name: dict[str, Reader] = {}
    for reader in [kind() for kind in sorted(reader_classes(), key=rank)]:
        if reader.name in by_name:
            kinds = (type(by_name[reader.name]), type(reader))
            classes = " and ".join(f"{kind.__module__}.{kind.__name__}" for kind in kinds)
            raise ConfigError(f"two readers have the name '{reader.name}': {classes}; rename one")
        by_name[reader.name] = reader
    return list(by_name.values())


def format_names() -> str:
    """Return the names of all formats in the form `A, B or C`."""
    *others, last = (reader.name for reader in readers())
    return f"{', '.join(others)} or {last}"


def find_reader(path: Path) -> Reader | None:
    """Return the first reader that matches the dataset in a folder, or None."""
    return next((reader for reader in readers() if reader.matches(path)), None)


def is_scene(path: Path) -> bool:
    """Return whether a folder holds a dataset in a format that read_scene can read."""
    return find_reader(path) is not None


def read_scene(path: str | Path, holdout: int | Split = HOLDOUT) -> Scene:
    """Read the dataset in a folder; every `holdout`-th view is a test view if the dataset has no split.

    A Split can also name the test views, hold out a validation fold, and leave out training views.
    Raises DataError if the format is unknown or files are damaged.
    """
    path = Path(path)
    if not path.is_dir():
        fault = "no such folder"
        if path.is_file():
            model = model_format(path)
            fault = f"is a model ({model.name}), which `clsplat check` reads" if model else "is a file"
        raise DataError(f"{path}: {fault}; expected the folder of a dataset")
    split = holdout if isinstance(holdout, Split) else Split(holdout)
    if reader := find_reader(path):
        reader.missing = split.missing
        return split.applied(reader.read(path, split.of_reader))
    if any(is_image(file) for file in path.iterdir()):
        raise DataError(
            f"{path}: photographs without cameras; `clsplat run photos --scene {shell_quote(path)}` finds the cameras"
        )
    known = ", ".join(f"{reader.name} ({reader.expects})" for reader in readers())
    raise DataError(f"{path}: no dataset found; looked for {known}")
