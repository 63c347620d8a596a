"""Hash the input files of a pipeline, so that runs are compared by content rather than by path."""

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

Change = Callable[[str, Path], str]  # maps a setting and the path to which it refers to a new setting


def with_content_hashes(pipeline: Pipeline) -> dict[str, Any]:
    """Return the resolved pipeline with each input path replaced by a hash of its content.

    The folder of the scene is omitted, because a scene is identified by its content.  Raises DataError for unreadable
    files.
    """
    return _map_paths(pipeline, lambda text, path: hash_content(path) or text, None).resolved_settings()


def with_absolute_paths(pipeline: Pipeline) -> Pipeline:
    """Return the pipeline with absolute paths, for a process with another working folder."""
    scene = pipeline.settings.scene.path
    return _map_paths(pipeline, lambda text, path: str(path.absolute()), scene and str(Path(scene).absolute()))


def content_hashes(pipeline: Pipeline) -> dict[str, str]:
    """Return the hashes of the readable input files, keyed by their paths as written in the pipeline."""
    hashes: dict[str, str] = {}

    def add(text: str, path: Path) -> str:
        with suppress(DataError):
            if digest := hash_content(path):
                hashes[text] = digest
        return text

    _map_paths(pipeline, add, None)
    return hashes


def hash_content(path: Path) -> str:
    """Return a hash of a file, of a model with its side files, or of a folder of images; "" if the path does not exist.

    Raises DataError for other folders, and for files that cannot be read.
    """
    if not os.path.exists(path):
        return ""
    try:
        return _hash_content(path)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error


def _hash_content(path: Path) -> str:
    model = model_path(path)
    if not model.is_file() and any(is_image(file) for file in path.rglob("*")):
        return f"sha256:{fingerprint(path, path / 'nothing')}"
    if not model.is_file():
        raise DataError(f"{path}: contains no model; expected a model file or the folder of a finished run")
    side_files = [file for file in (*model_files(model), sky_path(model)) if file != model and file.is_file()]
    digests = " ".join(map(_digest, (model, *side_files)))
    return f"sha256:{hashlib.sha256(digests.encode()).hexdigest() if side_files else digests}"


def _digest(file: Path) -> str:
    state = file.stat()
    return _cached_sha256(file.absolute(), state.st_ino, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=256)  # the cells of a sweep name the same files
def _cached_sha256(file: Path, inode: int, size: int, time: int) -> str:
    return sha256(file)


def _map_paths(pipeline: Pipeline, change: Change, scene: str | None) -> Pipeline:
    """Return the pipeline with `change` applied to its input paths, and with `scene` as its scene folder."""
    settings = pipeline.settings
    without_scene = settings.model_copy(update={"scene": settings.scene.model_copy(update={"path": None})})
    new_settings = _map_value(without_scene, settings.scene.path, change)
    new_scene = new_settings.scene.model_copy(update={"path": scene})
    return replace(pipeline, settings=new_settings.model_copy(update={"scene": new_scene}))


def _map_value(value: Any, scene: str | None, change: Change) -> Any:
    if isinstance(value, Settings):
        changes = {}
        for key in type(value).model_fields:
            setting, path = getattr(value, key), value.input_path(key, scene)
            changes[key] = _map_value(setting, scene, change) if path is None else change(setting, path)
        return value.model_copy(update=changes)
    if isinstance(value, list | tuple):
        return type(value)(_map_value(item, scene, change) for item in value)
    if isinstance(value, dict):
        return {key: _map_value(item, scene, change) for key, item in value.items()}
    return value
