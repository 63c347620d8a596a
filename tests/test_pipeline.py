"""Pipeline files: what is accepted, what is refused and in which words."""

import json
from pathlib import Path

import pytest

from clsplat import resource_dir
from clsplat.errors import ConfigError
from clsplat.pipeline import load
from clsplat.schema import json_schema
from clsplat.yaml_file import read_yaml

SHIPPED = sorted(path.stem for path in resource_dir("pipelines").glob("*.yaml"))
SMALL = """\
name: small
stages:
  - init
  - optimize:
      steps: 10
      losses:
        - {type: l1, weight: 0.8}
        - {type: dssim, weight: 0.2}
      during:
        - densify:
            every: 100
            rules:
              - {type: clone}
        - checkpoint: {every: 5}
  - evaluate
  - export
"""


@pytest.fixture
def write(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / "x.yaml"
        path.write_text(text)
        return str(path)

    return write


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_pipelines_are_fine_and_resolve_to_themselves(name, write):
    pipeline = load(name)
    assert pipeline.settings.name == name
    again = load(write(pipeline.text()))
    assert again.resolved() == pipeline.resolved()


def test_the_short_recipe_differs_only_where_its_header_says():
    full, short = load("splat").resolved(), load("splat_7k").resolved()
    assert full["model"] == short["model"]
    full_optimize, short_optimize = full["stages"][1]["optimize"], short["stages"][1]["optimize"]
    short_optimize["steps"] = full_optimize["steps"]
    short_optimize["rates"]["means"]["over"] *= 2
    for stage, other in zip(full_optimize["during"], short_optimize["during"], strict=True):
        name = next(iter(stage))
        assert other[name].keys() == stage[name].keys()
        other[name]["stop"] = stage[name]["stop"]
        if name == "evaluate":
            other[name]["every"] = stage[name]["every"]
    assert short["stages"] == full["stages"]


def replaced(old: str, new: str) -> str:
    assert old in SMALL
    return SMALL.replace(old, new)


REFUSED = {
    "misspelt key": (
        replaced("weight: 0.8", "wieght: 0.8"),
        r"x.yaml:7: stages\[1\].optimize.losses\[0\].wieght: unknown key 'wieght'; did you mean 'weight'",
    ),
    "misspelt stage": (replaced("- evaluate", "- evalute"), r"no stage named 'evalute'; did you mean 'evaluate'\?"),
    "misspelt loss": (
        replaced("type: dssim", "type: dsim"),
        r"x.yaml:8: stages\[1\].optimize.losses\[1\].*no loss named 'dsim'; did you mean 'dssim'\?",
    ),
    "misspelt rule": (
        replaced("type: clone", "type: clon"),
        r"during\[0\].densify.rules\[0\].*no rule named 'clon'; did you mean 'clone'\?",
    ),
    "misspelt top key": (replaced("name: small", "nam: small"), "unknown key 'nam'; did you mean 'name'"),
    "text for a number": (
        replaced("steps: 10", "steps: 30k"),
        r"x.yaml:5: stages\[1\].optimize.steps: expected a whole number, got '30k'",
    ),
    "quoted number": (replaced("steps: 10", "steps: '10'"), "expected a whole number, got '10'"),
    "fraction for a whole": (replaced("steps: 10", "steps: 10.5"), "expected a whole number, got 10.5"),
    "negative": (replaced("steps: 10", "steps: -1"), "greater than 0, got -1"),
    "infinite": (replaced("weight: 0.8", "weight: .inf"), "finite"),
    "missing steps": (replaced("      steps: 10\n", ""), "'steps' is missing"),
    "no cadence": (replaced("checkpoint: {every: 5}", "checkpoint"), "needs 'every' inside 'during'"),
    "cadence outside": (replaced("- evaluate", "- evaluate: {every: 3}"), r"'every' belongs inside optimize.during"),
    "wrong order": (
        replaced("  - init\n", ""),
        r"stages\[0\] optimize needs 'model', which no earlier stage makes \(init makes it\)",
    ),
    "stage not for during": (replaced("checkpoint: {every: 5}", "init: {every: 5}"), "no stage named 'init'"),
    "duplicate key": (replaced("steps: 10", "steps: 10\n      steps: 20"), r"x.yaml:6: found duplicate key"),
    "two keys in a stage": (
        replaced("  - evaluate", "  - evaluate: {}\n    export: {}"),
        r"stages\[2\]: expected '- stage'",
    ),
    "not yaml": ("name: [", r"x.yaml:\d"),
    "a list": ("- a\n- b\n", "expected keys such as name and stages"),
    "empty": ("", "expected keys"),
    "tagged object": ("name: !!python/object:os.system small\n", "x.yaml"),
    "unsafe name": (replaced("name: small", "name: ../up"), "name"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals(case, write):
    text, words = REFUSED[case]
    with pytest.raises(ConfigError, match=words) as error:
        load(write(text))
    assert "\n" not in str(error.value)
    assert error.value.exit_code == 2


def test_alias_bombs_and_large_files_are_refused(write):
    layers = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    layers += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    for text in ("\n".join(layers), "x" * (2 << 20)):
        with pytest.raises(ConfigError):
            read_yaml(Path(write(text)))


def test_numbers_are_yaml_1_2(write):
    data = read_yaml(Path(write("a: 1e-4\nb: no\nc: 010\nd: 0x10\n"))).data
    assert data == {"a": 1e-4, "b": "no", "c": 10, "d": 16}


def test_overrides(write):
    path = write(SMALL)
    pipeline = load(path, [
        "optimize.steps=500", "model.sh_degree=1", "densify.every=50", "optimize.losses[0].weight=1e-1",
        "scene.downscale=2", "optimize.checkpoint.every=7", "seed=3",
    ])  # fmt: skip
    optimize = pipeline.settings.stages[1]
    assert optimize.steps == 500
    assert pipeline.settings.model.sh_degree == 1
    assert optimize.during[0].every == 50
    assert optimize.losses[0].weight == 0.1
    assert optimize.during[1].every == 7
    assert pipeline.settings.scene.downscale == 2
    assert pipeline.settings.seed == 3


@pytest.mark.parametrize(("override", "words"), [
    ("optimize.stps=5", "unknown key 'stps'; did you mean 'steps'"),
    ("optimze.steps=5", "did you mean optimize"),
    ("optimize.steps", "expected stage.key=value"),
    ("optimize.steps=30k", "expected a whole number, got '30k'"),
    ("optimize.losses.9.weight=1", "not a place"),
])  # fmt: skip
def test_override_refusals(write, override, words):
    with pytest.raises(ConfigError, match=words):
        load(write(SMALL), [override])


def test_unknown_pipelines_name_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'splat'"):
        load("splatt")
    with pytest.raises(ConfigError, match="no such pipeline file"):
        load("nowhere.yaml")


def test_schema_describes_the_file():
    schema = json_schema()
    assert json.loads(json.dumps(schema)) == schema
    names = {
        next(iter(item["properties"]))
        for item in schema["properties"]["stages"]["items"]["oneOf"]
        if "properties" in item
    }
    assert {"init", "optimize", "evaluate", "export"} <= names
    assert "steps" in schema["$defs"]["Optimize"]["properties"]
