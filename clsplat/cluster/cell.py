"""A cell: one run of a sweep, named by the content of all that decides its bits, and by no place."""

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from clsplat.cluster.fingerprint import code_digest, tools_digest
from clsplat.errors import DataError
from clsplat.pipeline.loading import Pipeline
from clsplat.pipeline.places import content_of, contents, in_place, placeless

KEY = 20  # hexadecimal digits of the hash that names a cell


@dataclass(frozen=True)
class Cell:
    """One run, and the pipeline file that runs it on this machine."""

    name: str  # in its sweep
    spec: dict[str, Any]  # what its key is made of: pipeline, scene, code, bits
    text: str  # the resolved pipeline, with absolute paths
    files: dict[str, str] = field(default_factory=dict)  # hashes of the files that it names, by path

    @classmethod
    def of(cls, name: str, pipeline: Pipeline, scene: str, bits: str) -> "Cell":
        """Return the cell of a pipeline.  scene: the fingerprint of its scene; bits: the bits class of its device.

        Raises DataError when a file that it names cannot be read.
        """
        placed = in_place(pipeline)
        spec = {"pipeline": placeless(placed), "scene": scene, "code": code_digest(), "bits": bits}
        if pipeline.settings.prepare:
            spec["tools"] = tools_digest()
        return cls(name, spec, placed.text(), contents(placed))

    @classmethod
    def from_json(cls, text: str) -> "Cell":
        """Return what `json` returned."""
        return cls(**json.loads(text))

    def json(self) -> str:
        """Return the cell as text, for another process."""
        return json.dumps(asdict(self))

    def require_files(self) -> None:
        """Raise DataError where a file that it names does not hold here what its key was made of."""
        for path, digest in self.files.items():
            if content_of(Path(path)) != digest:
                raise DataError(
                    f"cell {self.name}: {path} is not what it was where the sweep began; put that file there, or run "
                    "the sweep again"
                )

    @property
    def key(self) -> str:
        """The name of its folder in a store."""
        return hashlib.sha256(json.dumps(self.spec, sort_keys=True).encode()).hexdigest()[:KEY]
