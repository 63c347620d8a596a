"""Pipeline files with a matrix, and the settings of recipes."""

from clsplat.pipeline.matrix import Experiment

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


def names(actual: Experiment | None) -> list[str]:
    assert actual is not None
    return [cell.name for cell in actual.cells]


def flat(value: object, place: str = "") -> dict[str, object]:
    """Every setting by its place; stages and rules go by their names, the second of a name as name~2."""
    if isinstance(value, dict) and "type" in value and place:
        value = {key: inner for key, inner in value.items() if key != "type"} | {"": value["type"]}
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in flat(inner, f"{place}.{key}".strip(".")).items()}
    if isinstance(value, list) and all(isinstance(item, dict) for item in value):
        names: list[str] = []
        results: dict[str, object] = {}
        for item in value:
            name = item.get("type") or next(iter(item))
            names.append(name)
            key = f"{place}.{name}" + (f"~{names.count(name)}" if names.count(name) > 1 else "")
            results |= flat(item if "type" in item else item[name], key)
        return results
    return {place: value}


# Recipes that stand for all: together they have every stage, rule, loss, filter and transform of those that train.
KINDS = (
    *("smoke", "splat", "fast", "photos", "blocks", "compress", "dash_mip_7k", "mcmc_7k", "fastgs_7k", "taming_7k"),
    *("auto_7k", "auto_opti3dgs_7k", "box_7k", "dynamic_7k", "gdgs_7k", "micro_splatting_v2_7k", "mini_7k"),
    *("gns_7k", "improved_gs_7k", "opti3dgs_7k", "splat_ewa_7k", "steep_7k", "surface"),
)
# Those of them whose schedules differ.
SCHEDULED = tuple(
    name for name in KINDS if name not in ("box_7k", "gdgs_7k", "opti3dgs_7k", "splat_ewa_7k", "steep_7k", "surface")
)
