"""The JSON schema of pipeline files, for editors that complete and check them."""

from collections.abc import Mapping, Sequence
from typing import Any

from clsplat.pipeline.execution import Execution
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.matrix import Matrix
from clsplat.prepare.steps import Step
from clsplat.settings import Settings, needs_settings, variants
from clsplat.stages.base import Scheduled, Stage
from clsplat.stages.training import Training


def json_schema() -> dict[str, Any]:
    """Return the schema in the shape of the file: a stage is its name, or its name with settings."""
    schema = PipelineFile.model_json_schema()
    definitions = schema["$defs"]
    for kind in (*variants(Stage).values(), *variants(Step).values()):
        definitions[kind.__name__]["properties"].pop("stage", None)
        definitions[kind.__name__]["required"] = [
            key for key in definitions[kind.__name__].get("required", []) if key != "stage"
        ]
    schema["properties"]["stages"]["items"] = _items(variants(Stage))
    schema["properties"]["prepare"]["items"] = _items(variants(Step))
    beside: dict[str, type[Settings]] = {"matrix": Matrix, "execution": Execution}
    for key, kind in beside.items():
        own = kind.model_json_schema()
        definitions |= {**own.pop("$defs", {}), kind.__name__: own}
        schema["properties"][key] = {"$ref": f"#/$defs/{kind.__name__}"}
    schema["required"].remove("stages")  # not required beside a matrix that names pipelines
    schema["anyOf"] = [
        {"required": ["stages"]},
        {"required": ["matrix"], "properties": {"matrix": {"required": ["pipelines"]}}},
    ]
    for kind in variants(Stage).values():
        if issubclass(kind, Training):
            definitions[kind.__name__]["properties"]["during"]["items"] = _items(variants(Scheduled), ["every"])
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _items(stages: Mapping[str, type[Settings]], required: Sequence[str] = ()) -> dict[str, Any]:
    """The items of a list of stages, each with the `required` keys beside those that it requires itself."""
    alone = sorted(name for name, kind in stages.items() if not required and not needs_settings(kind))
    with_settings = [
        {
            "type": "object",
            "properties": {name: _settings(kind.__name__, required, name in alone)},
            "required": [name],
            "additionalProperties": False,
        }
        for name, kind in stages.items()
    ]
    return {"oneOf": [*([{"enum": alone}] if alone else []), *with_settings]}


def _settings(title: str, required: Sequence[str], optional: bool) -> dict[str, Any]:
    node: dict[str, Any] = {"$ref": f"#/$defs/{title}"}
    node |= {"required": list(required)} if required else {}
    return {"anyOf": [node, {"type": "null"}]} if optional else node
