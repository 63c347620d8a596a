"""Summarize pipelines, list their keys, and copy them."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from clsplat.core.errors import ConfigError
from clsplat.core.files import path_exists, write_text
from clsplat.core.settings import Settings, needs_settings, variants
from clsplat.core.text_table import text_table
from clsplat.pipeline.execution import LocalExecution
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.files import VARIANT_SUFFIXES, find, origin, shipped_pipelines
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Matrix
from clsplat.pipeline.overrides import Key, list_keys
from clsplat.pipeline.yaml_file import read_pipeline
from clsplat.prepare.steps import Step
from clsplat.training.stage import Scheduled, Stage, Training

MAX_KEY_WIDTH = 44  # characters, of the column with keys


def summary(path: Path) -> str:
    """Return the first sentence of a pipeline file's opening comment."""
    lines = []
    for line in read_pipeline(path).splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.removeprefix("#").strip())
    return re.split(r"(?<=\.)\s+(?=[A-Z])", " ".join(lines), maxsplit=1)[0]


def summaries() -> list[dict[str, str]]:
    """Return the name, summary, and path of each shipped pipeline."""
    files = shipped_pipelines()
    return [{"name": name, "summary": summary(path), "path": str(origin(path))} for name, path in files.items()]


def summaries_text(pipelines: list[dict[str, str]]) -> str:
    """Format the result of `summaries` as a table."""
    return text_table(((pipeline["name"], pipeline["summary"]) for pipeline in pipelines), left_columns=2)


def manual(name: str) -> dict[str, Any]:
    """Return a pipeline's name, summary, path, and stages, and its keys for --set with their values and descriptions.

    Raises ConfigError.
    """
    pipeline = load(name)
    settings = pipeline.settings
    return {
        "name": settings.name,
        "summary": summary(pipeline.path),
        "path": str(origin(pipeline.path)),
        "stages": pipeline.names,
        "keys": [asdict(key) for key in list_keys(settings)],
    }


def manual_text(pipeline: dict[str, Any]) -> str:
    """Format the result of `manual` as text, with one line per key, its value, and its description."""
    keys = [Key(**key) for key in pipeline["keys"]]
    width = min(max(len(key.text) for key in keys), MAX_KEY_WIDTH)
    lines = [f"{key.text:<{width}}  {' '.join(key.description.split())}".rstrip() for key in keys]
    head = [f"{pipeline['name']}: {pipeline['summary']}", f"file: {pipeline['path']}"]
    head.append(f"stages: {', '.join(pipeline['stages'])}")
    return "\n".join([*head, "", "Keys, as for --set:", *lines])


def copy(name: str, file: Path) -> Path:
    """Copy a pipeline to a file or into a folder, and return the path of the copy.

    Raises ConfigError if that file exists.
    """
    source = find(name)
    target = file / source.name if path_exists(file) and file.is_dir() else file
    if path_exists(target):
        raise ConfigError(f"{target}: exists; choose another name")
    write_text(target, read_pipeline(source))
    return target


# The JSON schema of pipeline files, for editors that complete and check them.


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a pipeline file, in which a stage is a name, or a name with settings."""
    schema = PipelineFile.model_json_schema()
    definitions = schema["$defs"]
    for cls in (*variants(Stage).values(), *variants(Step).values()):
        definitions[cls.__name__]["properties"].pop("stage", None)
        definitions[cls.__name__]["required"] = [
            key for key in definitions[cls.__name__].get("required", []) if key != "stage"
        ]
    schema["properties"]["stages"]["items"] = _items(variants(Stage))
    schema["properties"]["prepare"]["items"] = _items(variants(Step))
    models: dict[str, type[Settings]] = {"matrix": Matrix, "execution": LocalExecution}
    for key, cls in models.items():
        definition = cls.model_json_schema()
        definitions |= {**definition.pop("$defs", {}), cls.__name__: definition}
        schema["properties"][key] = {"$ref": f"#/$defs/{cls.__name__}"}
    for key, ending in VARIANT_SUFFIXES.items():
        text = f"Values for the pipeline NAME{ending}, by keys as for --set; the comment above describes that pipeline."
        schema["properties"][key] = {"type": "object", "title": key.title(), "description": text}
    schema["required"].remove("stages")  # not required if the matrix lists pipelines
    schema["anyOf"] = [
        {"required": ["stages"]},
        {"required": ["matrix"], "properties": {"matrix": {"required": ["pipelines"]}}},
    ]
    for cls in variants(Stage).values():
        if issubclass(cls, Training):
            definitions[cls.__name__]["properties"]["during"]["items"] = _items(variants(Scheduled), ["every"])
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _items(stages: Mapping[str, type[Settings]], required: Sequence[str] = ()) -> dict[str, Any]:
    """Return the schema of the stages in a list.  Every stage also needs the `required` keys."""
    names = sorted(name for name, cls in stages.items() if not required and not needs_settings(cls))
    with_settings = [
        {
            "type": "object",
            "properties": {name: _settings(cls.__name__, required, name in names)},
            "required": [name],
            "additionalProperties": False,
        }
        for name, cls in stages.items()
    ]
    return {"oneOf": [*([{"enum": names}] if names else []), *with_settings]}


def _settings(title: str, required: Sequence[str], is_optional: bool) -> dict[str, Any]:
    node: dict[str, Any] = {"$ref": f"#/$defs/{title}"}
    node |= {"required": list(required)} if required else {}
    return {"anyOf": [node, {"type": "null"}]} if is_optional else node
