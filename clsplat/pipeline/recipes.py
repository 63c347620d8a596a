"""Summaries and keys of pipelines, and copies of them."""

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError
from clsplat.files import is_there, write_text
from clsplat.pages.columns import text_table
from clsplat.pipeline.files import find, shipped
from clsplat.pipeline.loading import load
from clsplat.pipeline.settable import Key, settable
from clsplat.pipeline.yaml_file import read_pipeline

MAX_KEY_WIDTH = 44  # characters; descriptions stand beside


def summary(path: Path) -> str:
    """Return the first sentence of a pipeline file's opening comment."""
    lines = []
    for line in read_pipeline(path).splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.removeprefix("#").strip())
    return re.split(r"(?<=\.)\s+(?=[A-Z])", " ".join(lines), maxsplit=1)[0]


def summaries() -> list[dict[str, str]]:
    """Return name, summary and path of every shipped pipeline."""
    return [{"name": name, "summary": summary(path), "path": str(path)} for name, path in shipped().items()]


def summaries_text(found: list[dict[str, str]]) -> str:
    """Return a line for each of `summaries`."""
    return text_table(((one["name"], one["summary"]) for one in found), left=2)


def manual(name: str) -> dict[str, Any]:
    """Return a pipeline's name, summary, path, stages, and the keys that --set takes, with values and descriptions.

    Raises ConfigError.
    """
    pipeline = load(name)
    settings = pipeline.settings
    return {
        "name": settings.name,
        "summary": summary(pipeline.path),
        "path": str(pipeline.path),
        "stages": pipeline.names,
        "keys": [asdict(key) for key in settable(settings)],
    }


def manual_text(found: dict[str, Any]) -> str:
    """Return a `manual` as lines of text: a key with its value, and what it means."""
    keys = [Key(**key) for key in found["keys"]]
    width = min(max(len(key.text) for key in keys), MAX_KEY_WIDTH)
    lines = [f"{key.text:<{width}}  {' '.join(key.description.split())}".rstrip() for key in keys]
    head = [f"{found['name']}: {found['summary']}", f"file: {found['path']}", f"stages: {', '.join(found['stages'])}"]
    return "\n".join([*head, "", "Each key, as --set takes it:", *lines])


def copy(name: str, file: Path) -> Path:
    """Copy a pipeline to a file, or into a folder; return the copy.  Raises ConfigError when the copy exists."""
    source = find(name)
    target = file / source.name if is_there(file) and file.is_dir() else file
    if is_there(target):
        raise ConfigError(f"{target}: exists and is not overwritten; give another name")
    write_text(target, read_pipeline(source))
    return target
