"""Where a model lies, and which files belong to it."""

from pathlib import Path

from clsplat.errors import DataError, quoted
from clsplat.formats.lod import LOD_META, files_of_lod
from clsplat.formats.sog_files import META, with_images


def located(path: Path) -> Path:
    """Return the file of a model: of a folder with a meta.json, or a lod-meta.json, that one."""
    places = (path / name for name in (META, LOD_META)) if path.is_dir() else ()
    return next(filter(Path.is_file, places), path)


def files_of(place: Path) -> list[Path]:
    """Return all files of a model's file: of the JSON of SOG, or of levels, those that it names, too."""
    return {META: with_images, LOD_META: files_of_lod}.get(place.name, lambda one: [one])(place)


def bytes_of(path: Path) -> int:
    """Return the size of a model: of a folder of SOG, or of levels, that of all files that its JSON names.

    Raises DataError where one is missing.
    """
    place = located(path)
    try:
        return sum(one.stat().st_size for one in files_of(place))
    except OSError as error:
        missing = "" if error.filename == str(place) else f"names {quoted(error.filename)}, which "
        raise DataError(f"{place}: {missing}cannot be read ({error.strerror}); copy or export it again") from error
