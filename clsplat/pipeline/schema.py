"""The JSON schema of pipeline files, for editors that complete and check them."""

from typing import Any

from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.matrix import Matrix
from clsplat.prepare.steps import Step
from clsplat.settings import Settings, variants
from clsplat.stages.base import Scheduled, Stage


def json_schema() -> dict[str, Any]:
    """Return the schema in the shape of the file: a stage is its name, or its name with settings."""
    schema = PipelineFile.model_json_schema()
    definitions = schema["$defs"]
    stages, scheduled, steps = (_titles(base) for base in (Stage, Scheduled, Step))
    for title in (*stages, *steps):
        definitions[title]["properties"].pop("stage", None)
    schema["properties"]["stages"]["items"] = _items(stages)
    schema["properties"]["prepare"]["items"] = _items(steps)
    matrix = Matrix.model_json_schema()
    definitions |= {**matrix.pop("$defs", {}), "Matrix": matrix}
    schema["properties"]["matrix"] = {"$ref": "#/$defs/Matrix"}
    schema["required"].remove("stages")  # not required beside a matrix that names pipelines
    schema["anyOf"] = [
        {"required": ["stages"]},
        {"required": ["matrix"], "properties": {"matrix": {"required": ["pipelines"]}}},
    ]
    definitions["Optimize"]["properties"]["during"]["items"] = _items(scheduled)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _titles(base: type[Settings]) -> dict[str, str]:
    """Names of the variants by the titles of their definitions."""
    return {kind.__name__: name for name, kind in variants(base).items()}


def _items(stages: dict[str, str]) -> dict[str, Any]:
    with_settings = [
        {
            "type": "object",
            "properties": {name: {"$ref": f"#/$defs/{title}"}},
            "required": [name],
            "additionalProperties": False,
        }
        for title, name in stages.items()
    ]
    return {"oneOf": [{"enum": sorted(stages.values())}, *with_settings]}
