"""Find pipeline files by path, or by the name of a shipped pipeline.

A file NAME.yaml with the key `short` defines two pipelines, NAME and NAME_7k.  The keys `draft` and `high` define
NAME_draft and NAME_high.  The path of such a variant does not exist on disk: `read_pipeline` creates its text from
NAME.yaml.
"""

import difflib
import re
from pathlib import Path

from clsplat.core.errors import ConfigError, quote, shell_quote
from clsplat.core.files import PIPELINE
from clsplat.core.reading import read_file
from clsplat.core.resources import resource_dir

VARIANT_SUFFIXES = {"short": "_7k", "draft": "_draft", "high": "_high"}  # of names, by key in the file
VARIANT_KEY = re.compile(rf"^({'|'.join(VARIANT_SUFFIXES)})\s*:".encode(), re.MULTILINE)


def shipped_pipelines() -> dict[str, Path]:
    """Return the paths of the shipped pipelines by name, sorted."""
    files = list(resource_dir("pipelines").glob("*.yaml"))
    keys = {file: VARIANT_KEY.findall(file.read_bytes()) for file in files}
    files += [file.with_stem(file.stem + VARIANT_SUFFIXES[key.decode()]) for file in files for key in keys[file]]
    return {file.stem: file for file in sorted(files)}


def origin(path: Path) -> Path:
    """Return the file on disk that defines a pipeline: NAME.yaml for NAME_7k.yaml if only the first exists."""
    key = variant_key(path)
    base = path.with_stem(path.stem.removesuffix(VARIANT_SUFFIXES[key])) if key else path
    return base if base != path and base.is_file() and not path.exists() else path


def variant_key(path: Path) -> str | None:
    """Return the key that defines a variant, such as `short` for NAME_7k.yaml; None for other names."""
    keys = (key for key, suffix in VARIANT_SUFFIXES.items() if path.stem.endswith(suffix) and path.stem != suffix)
    return next(keys, None)


def variant_name(name: str, key: str) -> str:
    """Return the name or path of a variant, given the name or path of its pipeline.  Raises ConfigError."""
    path = find(name)
    if key.encode() not in VARIANT_KEY.findall(read_file(origin(path), "a pipeline file", ConfigError)):
        raise ConfigError(f"{name}: has no variant '{key}'; use a pipeline that has one, such as `photos`")
    return str(Path(name).with_stem(path.stem + VARIANT_SUFFIXES[key]))


def find(name: str) -> Path:
    """Return the file of a pipeline, given its path or the name of a shipped pipeline.  Raises ConfigError."""
    path = Path(name)
    try:
        is_folder = path.is_dir()
        is_file = path.exists() and not is_folder  # or a pipe, which the reader will refuse
        is_run = is_folder and (path / PIPELINE).is_file()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{quote(name)}: not a valid file name ({reason})") from error
    if is_file:
        return path
    if path.suffix in (".yaml", ".yml"):
        if origin(path) != path:
            return path
        raise ConfigError(f"{path}: no such pipeline file; `clsplat pipelines` lists pipelines by name")
    files = shipped_pipelines()
    if name in files:
        return files[name]
    if is_run:
        raise ConfigError(
            f"{path}: is a run folder, not a pipeline; `clsplat resume {shell_quote(path)}` continues the run"
        )
    if is_folder:
        remedy = f"to train on it, use `clsplat run splat_7k --scene {shell_quote(path)}`"
        raise ConfigError(f"{path}: is a folder; expected a pipeline file; {remedy}")
    matches = difflib.get_close_matches(name, files, n=1)
    advice = ", and no such file or folder; `clsplat pipelines` lists pipelines"
    hint = f"; did you mean '{matches[0]}'?" if matches else advice
    raise ConfigError(f"no pipeline named {quote(name)}{hint}")
