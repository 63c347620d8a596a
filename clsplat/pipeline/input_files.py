"""The files that a pipeline names: where runs are compared, what they hold stands for their places."""

import hashlib
import os
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from clsplat.core.errors import DataError
from clsplat.core.reading import sha256
from clsplat.core.settings import Settings
from clsplat.formats.table import files_of
from clsplat.gaussians.model import model_at
from clsplat.gaussians.sky import sky_file
from clsplat.pipeline.loading import Pipeline
from clsplat.prepare.cache import fingerprint
from clsplat.scene.images import is_image

Change = Callable[[str, Path], str]  # from the text of a path, and the place that it names, to another text


def placeless(pipeline: Pipeline) -> dict[str, Any]:
    """Return the resolved pipeline without places: for a file that it reads stands the hash of its content.

    The folder of the scene is left out: a scene has an identity.  Raises DataError when a file cannot be read.
    """
    return _with(pipeline, lambda text, place: content_of(place) or text, None).resolved()


def in_place(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline with absolute paths, for a process that begins in another folder."""
    path = pipeline.settings.scene.path
    return _with(pipeline, lambda text, place: str(place.absolute()), path and str(Path(path).absolute()))


def contents(pipeline: Pipeline) -> dict[str, str]:
    """Return the hash of each file that is read, by the text that names it; what cannot be read is left out."""
    found: dict[str, str] = {}

    def note(text: str, place: Path) -> str:
        with suppress(DataError):
            if digest := content_of(place):
                found[text] = digest
        return text

    _with(pipeline, note, None)
    return found


def content_of(place: Path) -> str:
    """Return a hash of a file, of a model with all of its files, of that of a run folder, or of a folder of images; ""
    for no such place.

    Raises DataError for a folder with neither, and for what cannot be read.
    """
    if not os.path.exists(place):
        return ""
    try:
        return _content_of(place)
    except OSError as error:
        raise DataError(f"{place}: cannot be read ({error.strerror}); give another file, or its rights") from error


def _content_of(place: Path) -> str:
    model = model_at(place)
    if not model.is_file() and any(is_image(file) for file in place.rglob("*")):
        return f"sha256:{fingerprint(place, place / 'nothing')}"
    if not model.is_file():
        raise DataError(f"{place}: holds no model; expected a file, or the folder of a finished run")
    others = [file for file in (*files_of(model), sky_file(model)) if file != model and file.is_file()]
    digests = " ".join(map(_digest, (model, *others)))
    return f"sha256:{hashlib.sha256(digests.encode()).hexdigest() if others else digests}"


def _digest(file: Path) -> str:
    state = file.stat()
    return _known(file.absolute(), state.st_ino, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=256)  # the cells of a sweep name the same files
def _known(file: Path, number: int, size: int, time: int) -> str:
    return sha256(file)


def _with(pipeline: Pipeline, change: Change, scene: str | None) -> Pipeline:
    """The pipeline with other texts for what it reads, and this one for the folder of its scene."""
    settings = pipeline.settings
    other = settings.model_copy(update={"scene": settings.scene.model_copy(update={"path": None})})
    changed = _changed(other, settings.scene.path, change)
    placed = changed.scene.model_copy(update={"path": scene})
    return replace(pipeline, settings=changed.model_copy(update={"scene": placed}))


def _changed(value: Any, scene: str | None, change: Change) -> Any:
    if isinstance(value, Settings):
        changes = {}
        for key in type(value).model_fields:
            before, place = getattr(value, key), value.input_path(key, scene)
            changes[key] = _changed(before, scene, change) if place is None else change(before, place)
        return value.model_copy(update=changes)
    if isinstance(value, list | tuple):
        return type(value)(_changed(item, scene, change) for item in value)
    if isinstance(value, dict):
        return {key: _changed(item, scene, change) for key, item in value.items()}
    return value
