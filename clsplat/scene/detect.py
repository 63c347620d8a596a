"""Find the reader of a dataset among the shipped readers and those of plug-ins."""

import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PureWindowsPath

from clsplat.core.errors import ConfigError, DataError, first_few, shell_quote
from clsplat.formats.table import detect as model_format
from clsplat.scene.colmap import ColmapReader, find_models, read_images
from clsplat.scene.images import is_image
from clsplat.scene.llff import LlffReader
from clsplat.scene.lookup import describe_unsupported_cameras, walk_folders
from clsplat.scene.multicamera import MulticameraReader
from clsplat.scene.reader import Reader, reader_classes
from clsplat.scene.scene import HOLDOUT, Scene
from clsplat.scene.transforms_json import BlenderReader, MultiscaleReader, NerfstudioReader
from clsplat.scene.view_selection import Split

PRECEDENCE = (MulticameraReader, ColmapReader, BlenderReader, MultiscaleReader, NerfstudioReader, LlffReader)


def readers() -> list[Reader]:
    """Return the readers in order of precedence.

    Each shipped reader is followed by its subclasses in plug-ins; the other readers of plug-ins are last, in order of
    definition.  Raises ConfigError if two readers have the same name.
    """

    def rank(reader_type: type[Reader]) -> int:
        """Return the rank of a shipped reader or a subclass of it; other readers come last."""
        return next((i for i, shipped in enumerate(PRECEDENCE) if issubclass(reader_type, shipped)), len(PRECEDENCE))

    readers_by_name: dict[str, Reader] = {}
    for reader in [reader_type() for reader_type in sorted(reader_classes(), key=rank)]:
        if reader.name in readers_by_name:
            duplicates = (type(readers_by_name[reader.name]), type(reader))
            classes = " and ".join(f"{reader_type.__module__}.{reader_type.__name__}" for reader_type in duplicates)
            raise ConfigError(f"two readers have the name '{reader.name}': {classes}; rename one")
        readers_by_name[reader.name] = reader
    return list(readers_by_name.values())


def format_names() -> str:
    """Return the names of all dataset formats in one phrase, as `A, B or C`."""
    *names, last = (reader.name for reader in readers())
    return f"{', '.join(names)} or {last}"


def find_reader(path: Path) -> Reader | None:
    """Return the first reader that matches the dataset in a folder, or None if there is none."""
    return next((reader for reader in readers() if reader.matches(path)), None)


MAX_DEPTH = 2  # levels of folders below a scene to search for its dataset
FALLBACK_DEPTH = 4  # levels to search if there is no dataset up to MAX_DEPTH
logger = logging.getLogger("clsplat")


def find_datasets(path: Path) -> list[Reader]:
    """Return the reader of the dataset in a folder, otherwise the readers of all datasets in its subfolders."""
    return _find_datasets(path, MAX_DEPTH) or _find_datasets(path, FALLBACK_DEPTH)


def _find_datasets(path: Path, depth: int) -> list[Reader]:
    datasets = list[Reader]()
    for folder, _ in walk_folders(path, depth):
        if not any(folder.is_relative_to(reader.folder) for reader in datasets) and (reader := find_reader(folder)):
            reader.root, reader.folder = path, folder
            datasets.append(reader)
            if folder == path:
                break
    return datasets


def find_dataset(path: Path) -> Reader | None:
    """Return the reader of the dataset in a folder, or of the only dataset in its subfolders; None if there is none.

    If there are several models of the same photographs, the one with the image files is used, otherwise the largest
    (in a tie, the first by name).  Raises DataError, which lists the datasets, if there are several.
    """
    datasets = find_datasets(path)
    if len(datasets) < 2:
        return datasets[0] if datasets else None
    names = [_image_names(reader.folder) for reader in datasets]
    has_images = [
        any(is_image(Path(name)) for _, files in walk_folders(reader.folder, MAX_DEPTH) for name in files)
        for reader in datasets
    ]
    best = max(range(len(datasets)), key=lambda i: (has_images[i], len(names[i])))
    if sum(has_images) > 1 or not all(names[i] & names[best] for i in range(len(names))):
        candidates = first_few([f"{reader.folder.relative_to(path).as_posix()} ({reader.name})" for reader in datasets])
        raise DataError(f"{path}: has {len(datasets)} datasets in its subfolders: {candidates}; use one of these")
    datasets[best].choice = f", out of {len(datasets)} models of these photos"
    return datasets[best]


def _image_names(folder: Path) -> set[str]:
    """Return the names of the images of a COLMAP dataset, without folders and suffixes; empty if it is damaged."""
    with suppress(DataError):
        return {PureWindowsPath(image.name).stem for model in find_models(folder) for image in read_images(model)}
    return set()


def is_scene(path: Path) -> bool:
    """Return whether a folder contains a dataset in a format that read_scene can read."""
    return bool(find_datasets(path))


def read_scene(path: str | Path, holdout: int | Split = HOLDOUT) -> Scene:
    """Read the dataset in a folder; every `holdout`-th view is a test view if the dataset has no split.

    A Split can also name the test views, hold out a validation fold, and omit training views.
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
    if reader := find_dataset(path):
        if reader.note:
            logger.info("%s: %s", path, reader.note)
        reader.missing = split.missing
        return split.apply(replace(reader.read(reader.folder, split.reader_holdout), path=path))
    note = f"; {message}" if (message := describe_unsupported_cameras(path)) else ""
    if any(is_image(file) for file in path.iterdir()):
        parent = next((folder for folder in path.absolute().parents[:2] if find_reader(folder)), None)
        remedy = f"`clsplat run photos --scene {shell_quote(path)}` finds the cameras"
        remedy = f"the cameras are in {parent}: use that folder" if parent else remedy
        raise DataError(f"{path}: photos without cameras; {remedy}{note}")
    formats = ", ".join(f"{reader.name} ({reader.expects})" for reader in readers())
    raise DataError(f"{path}: no dataset found; looked for {formats}{note}")
