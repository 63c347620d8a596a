"""A cell: one run of a sweep, named by the content of all that decides its bits, and by no place."""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from clsplat.cluster.fingerprint import code_digest
from clsplat.pipeline.loading import Pipeline
from clsplat.reading import sha256
from clsplat.settings import Settings, is_read

KEY = 20  # hexadecimal digits of the hash that names a cell


@dataclass(frozen=True)
class Cell:
    """One run, and the pipeline file that runs it on this machine."""

    name: str  # in its sweep
    spec: dict[str, Any]  # what its key is made of: pipeline, scene, code, bits
    text: str  # the resolved pipeline, with the places of this machine

    @classmethod
    def of(cls, name: str, pipeline: Pipeline, scene: str, bits: str) -> "Cell":
        """Return the cell of a pipeline.  scene: the fingerprint of its scene; bits: the bits class of its device."""
        spec = {"pipeline": placeless(pipeline), "scene": scene, "code": code_digest(), "bits": bits}
        return cls(name, spec, pipeline.text())

    @classmethod
    def from_json(cls, text: str) -> "Cell":
        """Return what `json` returned."""
        values = json.loads(text)
        return cls(values["name"], values["spec"], values["text"])

    def json(self) -> str:
        """Return the cell as text, for another process."""
        return json.dumps({"name": self.name, "spec": self.spec, "text": self.text})

    @property
    def key(self) -> str:
        """The name of its folder in a store."""
        return hashlib.sha256(json.dumps(self.spec, sort_keys=True).encode()).hexdigest()[:KEY]


def placeless(pipeline: Pipeline) -> dict[str, Any]:
    """Return the resolved pipeline without places: of a file that it reads, the content's hash stands for the path.

    The folder of the scene is left out: a cell has its fingerprint.  Raises DataError when a file cannot be read.
    """
    scene = pipeline.settings.scene
    folders = [Path(), *([scene.folder] if scene.path is not None else [])]
    bare = pipeline.settings.model_copy(update={"scene": scene.model_copy(update={"path": None})})
    return replace(pipeline, settings=_without_paths(bare, folders)).resolved()


def _without_paths(value: Any, folders: list[Path]) -> Any:
    if isinstance(value, Settings):
        changes = {}
        for key in type(value).model_fields:
            before = getattr(value, key)
            is_path = isinstance(before, str) and is_read(type(value), key)
            changes[key] = _content(before, folders) if is_path else _without_paths(before, folders)
        return value.model_copy(update=changes)
    if isinstance(value, list | tuple):
        return type(value)(_without_paths(item, folders) for item in value)
    if isinstance(value, dict):
        return {key: _without_paths(item, folders) for key, item in value.items()}
    return value


def _content(text: str, folders: list[Path]) -> str:
    """The hash of a file's content; the text itself where it names none, as the name of a camera path."""
    for folder in folders:
        if (folder / text).is_file():
            return f"sha256:{sha256(folder / text)}"
    return text
