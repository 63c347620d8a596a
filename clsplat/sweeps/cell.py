"""Identify cells, which are the runs of a sweep, by a hash of everything that determines their bits."""

import hashlib
import json
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from clsplat.core.errors import DataError
from clsplat.core.reading import sha256
from clsplat.core.resources import __version__, list_sources
from clsplat.pipeline.file import SceneSettings
from clsplat.pipeline.input_files import content_hashes, hash_content, with_absolute_paths, with_content_hashes
from clsplat.pipeline.loading import Pipeline
from clsplat.prepare.cache import plan
from clsplat.scene.detect import read_scene
from clsplat.scene.identity import Identity, ImageFile
from clsplat.scene.scene import Scene
from clsplat.scene.view import NO_FILE

# Fingerprints of the content of a scene, and of the program.

HASH_DIGITS = 16  # number of hexadecimal digits
# libraries that decode photos, initialize Gaussians, and compress models (OpenCV includes libwebp)
LIBRARIES = ("numpy", "scipy", "opencv-contrib-python-headless", "zstandard", "deflate")


@dataclass(frozen=True)
class SceneFacts:
    """The fingerprint and the size of a scene."""

    digest: str
    pixels: float  # total number in all training images; determines the order of cells


@cache
def code_digest() -> str:
    """Return a hash of the package, its kernels, and the versions of libraries that affect the bits."""
    libraries = [*_versions(*LIBRARIES), f"zlib {zlib.ZLIB_RUNTIME_VERSION}", _builtin_zstd()]
    return _digest([__version__, *list_sources(), *libraries])


@cache
def tools_digest() -> str:
    """Return a hash of the versions of all other libraries that affect the output of `prepare`."""
    return _digest(_versions("pycolmap"))


def _versions(*names: str) -> Iterator[str]:
    for name in names:
        with suppress(PackageNotFoundError):
            yield f"{name} {version(name)}"


def _builtin_zstd() -> str:
    """Return the version of Zstandard in Python's standard library (3.14 and later), or an empty string."""
    with suppress(ImportError):
        from compression import zstd

        return f"zstd {zstd.zstd_version}"
    return ""


def _digest(parts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:HASH_DIGITS]


def identify(settings: SceneSettings, hash_file: Callable[[Path], str]) -> tuple[Scene, Identity]:
    """Read a scene and hash its files with `hash_file`; photos are not decoded.  Raises DataError."""
    scene, _ = settings.apply(read_scene(settings.folder, settings.split))
    paths = dict.fromkeys(path for view in scene.views for path in (view.image_path, view.mask_path))
    files = {path: ImageFile(digest=hash_file(path)) for path in paths if path is not None and path != NO_FILE}
    return scene, Identity.from_scene(scene, files)


class Scenes:
    """A cache of the fingerprints of scenes; each file is hashed only once."""

    def __init__(self, prepared: Path) -> None:
        """prepared: the folder for the output of `prepare`."""
        self._prepared = prepared
        self._cache: dict[str, SceneFacts] = {}
        self._hash_file = cache(_hash_file)

    def facts(self, pipeline: Pipeline) -> SceneFacts:
        """Return the fingerprint and the size of a pipeline's scene.

        The fingerprint is the digest that a run writes to inputs.json, or to prepared.json if it has `prepare` steps.
        Raises DataError if the scene cannot be read, and ConfigError if the pipeline has no scene.
        """
        settings = pipeline.settings
        steps = [step.model_dump(mode="json") for step in settings.prepare]
        key = json.dumps([settings.scene.model_dump(mode="json"), steps])
        if key not in self._cache:
            self._cache[key] = self._read(pipeline)
        return self._cache[key]

    def _read(self, pipeline: Pipeline) -> SceneFacts:
        settings = pipeline.settings.scene
        if steps := pipeline.settings.prepare:
            return SceneFacts(plan(steps, settings.folder, self._prepared)[-1].key, 0.0)
        scene, identity = identify(settings, self._hash_file)
        pixels = sum(view.camera.width * view.camera.height for view in scene.split("train")) / settings.downscale**2
        return SceneFacts(identity.digest, float(pixels))


def _hash_file(path: Path) -> str:
    with suppress(DataError):  # the run will report the error
        return sha256(path)
    return ""


KEY_DIGITS = 20  # number of hexadecimal digits of a cell's key


def is_key(value: Any) -> bool:
    """Return whether a value, for example from an untrusted store, has the format of a cell's key."""
    return isinstance(value, str) and re.fullmatch(f"[0-9a-f]{{{KEY_DIGITS}}}", value) is not None


@dataclass(frozen=True)
class CellRun:
    """A run of a sweep, with the text of its pipeline file on this machine."""

    name: str  # name in the sweep
    spec: dict[str, Any]  # the values whose hash is the key: pipeline, scene, code, bits
    text: str  # the resolved pipeline as YAML, with absolute paths
    files: dict[str, str] = field(default_factory=dict)  # hashes of the input files of the pipeline, by path

    @classmethod
    def from_pipeline(cls, name: str, pipeline: Pipeline, scene: str, bits: str) -> "CellRun":
        """Return the cell of a pipeline.

        scene: the fingerprint of its scene.  bits: the bits class of its device.  Raises DataError if an input file of
        the pipeline cannot be read.
        """
        resolved_pipeline = with_absolute_paths(pipeline)
        spec = {"pipeline": with_content_hashes(resolved_pipeline), "scene": scene, "code": code_digest(), "bits": bits}
        if pipeline.settings.prepare:
            spec["tools"] = tools_digest()
        return cls(name, spec, resolved_pipeline.text(), content_hashes(resolved_pipeline))

    @classmethod
    def from_json(cls, text: str) -> "CellRun":
        """Return a cell from its JSON."""
        return cls(**json.loads(text))

    def json(self) -> str:
        """Return the cell as JSON, for another process."""
        return json.dumps(asdict(self))

    def require_files(self) -> None:
        """Raise DataError if an input file on this machine has a different hash from the file used for the key."""
        for path, digest in self.files.items():
            if hash_content(Path(path)) != digest:
                raise DataError(
                    f"cell {self.name}: {path} differs from the file with which the sweep started; copy that file, "
                    "or run the sweep again"
                )

    @property
    def key(self) -> str:
        """The name of the cell's folder in a store."""
        return hashlib.sha256(json.dumps(self.spec, sort_keys=True).encode()).hexdigest()[:KEY_DIGITS]
