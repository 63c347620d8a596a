"""Hash the files that a pipeline names, so that runs are compared by content rather than by path."""

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
from clsplat.formats.table import model_files
from clsplat.gaussians.model import model_path
from clsplat.gaussians.sky import sky_path
from clsplat.pipeline.loading import Pipeline
from clsplat.prepare.cache import fingerprint
from clsplat.scene.images import is_image

Change = Callable[[str, Path], str]  # of the text of a path, and the path that it means, to another text


def with_content_hashes(pipeline: Pipeline) -> dict[str, Any]:
    """Return the resolved pipeline with the hash of the content in place of the path of each file that it reads.

    The folder of the scene is left out, as a scene has an identity.  Raises DataError if a file cannot be read.
    """
    return _with(pipeline, lambda text, path: content_of(path) or text, None).resolved()


def with_absolute_paths(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline with absolute paths, for a process with another working folder."""
    scene = pipeline.settings.scene.path
    return _with(pipeline, lambda text, path: str(path.absolute()), scene and str(Path(scene).absolute()))


def contents(pipeline: Pipeline) -> dict[str, str]:
    """Return the hash of each file that is read, by the text that names it, without files that cannot be read."""
    hashes: dict[str, str] = {}

    def add(text: str, path: Path) -> str:
        with suppress(DataError):
            if digest := content_of(path):
                hashes[text] = digest
        return text

    _with(pipeline, add, None)
    return hashes


def content_of(path: Path) -> str:
    """Return a hash of a file, of a model and its side files, or of a folder of images; "" if the path does not exist.

    Raises DataError for other folders, and for files that cannot be read.
    """
    if not os.path.exists(path):
        return ""
    try:
        return _content_of(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error


def _content_of(path: Path) -> str:
    model = model_path(path)
    if not model.is_file() and any(is_image(file) for file in path.rglob("*")):
        return f"sha256:{fingerprint(path, path / 'nothing')}"
    if not model.is_file():
        raise DataError(f"{path}: has no model; expected a file, or the folder of a finished run")
    others = [file for file in (*model_files(model), sky_path(model)) if file != model and file.is_file()]
    digests = " ".join(map(_digest, (model, *others)))
    return f"sha256:{hashlib.sha256(digests.encode()).hexdigest() if others else digests}"


def _digest(file: Path) -> str:
    state = file.stat()
    return _known(file.absolute(), state.st_ino, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=256)  # the cells of a sweep name the same files
def _known(file: Path, number: int, size: int, time: int) -> str:
    return sha256(file)


def _with(pipeline: Pipeline, change: Change, scene: str | None) -> Pipeline:
    """Return the pipeline with changed paths of the files that it reads, and with another folder of its scene."""
    settings = pipeline.settings
    other = settings.model_copy(update={"scene": settings.scene.model_copy(update={"path": None})})
    changed = _changed(other, settings.scene.path, change)
    moved = changed.scene.model_copy(update={"path": scene})
    return replace(pipeline, settings=changed.model_copy(update={"scene": moved}))


def _changed(value: Any, scene: str | None, change: Change) -> Any:
    if isinstance(value, Settings):
        changes = {}
        for key in type(value).model_fields:
            before, path = getattr(value, key), value.input_path(key, scene)
            changes[key] = _changed(before, scene, change) if path is None else change(before, path)
        return value.model_copy(update=changes)
    if isinstance(value, list | tuple):
        return type(value)(_changed(item, scene, change) for item in value)
    if isinstance(value, dict):
        return {key: _changed(item, scene, change) for key, item in value.items()}
    return value
