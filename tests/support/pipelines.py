"""Pipeline files with a matrix, and the settings of recipes."""

from clsplat.pipeline.files import shipped
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import Experiment
from clsplat.stages.optimize import Optimize

STAGES = """\
stages:
  - init: {count: 300}
  - optimize:
      steps: 4
      losses: [{type: l1}]
      log_every: 2
      during:
        - checkpoint: {every: 2}
  - evaluate
  - export
  - render
"""


OWN = """\
name: sweep
matrix:
  seeds: [0, 1]
  set:
    optimize.steps: [4, 6]
    init.opacity: [0.1]
"""


SMALL = OWN + STAGES


def names(found: Experiment | None) -> list[str]:
    assert found is not None
    return [cell.name for cell in found.cells]


def flat(value: object, place: str = "") -> dict[str, object]:
    """Every setting by its place; stages and rules go by their names, the second of a name as name~2."""
    if isinstance(value, dict) and "type" in value and place:
        value = {key: inner for key, inner in value.items() if key != "type"} | {"": value["type"]}
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in flat(inner, f"{place}.{key}".strip(".")).items()}
    if isinstance(value, list) and all(isinstance(item, dict) for item in value):
        names: list[str] = []
        found: dict[str, object] = {}
        for item in value:
            name = item.get("type") or next(iter(item))
            names.append(name)
            key = f"{place}.{name}" + (f"~{names.count(name)}" if names.count(name) > 1 else "")
            found |= flat(item if "type" in item else item[name], key)
        return found
    return {place: value}


TRAINING = [name for name in shipped() if any(isinstance(stage, Optimize) for stage in load(name).stages)]
