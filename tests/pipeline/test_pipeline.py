"""Pipeline files: accepted input, and refusals with their messages."""

import functools
import json
import re
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from ruamel.yaml import YAML

from clsplat.core.errors import ConfigError
from clsplat.pipeline import files
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.pipeline.plugins import load_file
from clsplat.pipeline.recipes import copy, json_schema
from clsplat.pipeline.yaml_file import read_pipeline, read_yaml
from clsplat.stages.optimize import Optimize
from tests.support.pipelines import KINDS, flat

EXAMPLES = Path(__file__).parents[2] / "examples"
SHIPPED = list(files.shipped_pipelines())
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


shipped = functools.cache(load)  # they are read in many tests, and changed in none


@pytest.fixture
def write(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / "x.yaml"
        path.write_text(text)
        return str(path)

    return write


def test_shipped_pipelines_are_valid_and_resolve_to_themselves(write):
    pipelines = {name: shipped(name) for name in SHIPPED}
    faults = [f"{name}: is named {one.settings.name}" for name, one in pipelines.items() if one.settings.name != name]
    again = {name: load(write(one.text())) for name, one in pipelines.items()}
    faults += [
        f"{name}: resolves to another"
        for name in SHIPPED
        if again[name].resolved_settings() != pipelines[name].resolved_settings()
    ]
    assert not faults, "\n".join(faults)


def test_every_scheduled_stage_of_a_shipped_pipeline_acts():
    faults = []
    for name in SHIPPED:
        before = 0
        for loop in [stage for stage in shipped(name).settings.stages if isinstance(stage, Optimize)]:
            last = before + loop.steps
            for stage in loop.during:
                steps = range(before + 1, last + (0 if stage.edits else 1))  # nothing is edited after the last step
                if not any(stage.is_due(step) for step in steps):
                    faults.append(f"{name}: {stage.stage}, every {stage.every}")
            before = last
    assert not faults, "\n".join(faults)


def kinds_of(node: object) -> set[str]:
    """Names of stages, rules, losses, filters and all else that has a type."""
    if isinstance(node, list):
        return {kind for item in node for kind in kinds_of(item)}
    if not isinstance(node, dict):
        return set()
    named = {str(node["type"])} if "type" in node else set()
    return named.union({str(node["stage"])} if "stage" in node else set(), *map(kinds_of, node.values()))


def test_representative_recipes_cover_all_kinds():
    kinds = {name: kinds_of(shipped(name).settings.model_dump(mode="json")) for name in SHIPPED}
    trained = [value for value in kinds.values() if "optimize" in value]
    assert set().union(*trained) - set().union(*(kinds[name] for name in KINDS)) == set()


@functools.cache
def settings_of(recipe: str) -> dict[str, object]:
    return flat(shipped(recipe).resolved_settings())


def changes(base: str, recipe: str) -> set[str]:
    """Places, shortened, in which a recipe has other settings than its base."""
    old, new = settings_of(base), settings_of(recipe)
    places = {place for place in old.keys() | new.keys() if old.get(place, "-") != new.get(place, "-")}
    return {place.removeprefix("stages.optimize.").removeprefix("during.") for place in places - {"name"}}


SMOOTHING = {"model.world_filter", "model.world_filter.focal", "model.world_filter.variance"}
MIP = {"model.screen_filter", "model.screen_filter.compensate", "model.screen_filter.variance"}
REFRESH = {f"refresh_filter.{key}" for key in ("every", "start", "stop")}
MATCHING = {
    f"densify.rules.{rule}~2{key}"
    for rule, size in (("clone", (".size_below",)), ("split", (".size_above", ".children", ".shrink")))
    for key in ("", ".start", ".statistic", ".as_many_as", ".gradient_above", ".opacity", *size)
}
SUBDIVIDE = (".start", ".max_fraction", ".beta", ".children", ".radius_above")
STAGE = ("budget", "every", "grow_until", "inside", "max_gaussians", "patience", "start", "stop")
THINNING = {
    *(f"densify~{n}.{key}" for n in (2, 3) for key in STAGE),
    *(f"densify~2.rules.prune_unimportant{key}" for key in ("", ".start", ".share")),
    *(f"densify~3.rules.merge_neighbors{key}" for key in ("", ".start", ".color_below", ".distance_below")),
}
LIMITED = {  # a limit of the opacity, in front of the resets
    *("reset_opacity.every", "reset_opacity.value", "reset_opacity~2.every", "reset_opacity~2.stop"),
    *("reset_opacity~2.when_background", "reset_opacity~3.every", "reset_opacity~3.start"),
    *("reset_opacity~3.stop", "reset_opacity~3.value", "reset_opacity~3.when_background"),
}


def rules(stage: str, **keys: str) -> set[str]:
    """The places of rules that a recipe has more, or less, by their keys."""
    return {
        f"{stage}.rules.{rule}{key}"
        for rule, named in keys.items()
        for key in ("", *(f".{item}" for item in named.split()))
    }


WRONG = " views error_above start"
FASTGS = {
    *rules("densify", prune_faint="opacity_below start", prune_large="size_above start"),
    *rules("densify", revert_growth="pixels_above" + WRONG),
    *rules("densify", prune_sampled="opacity_below share size_above.between size_above.points" + WRONG),
    *rules("densify~2", prune_faint="opacity_below start", prune_inaccurate="score_above" + WRONG),
    *(f"densify~2.{key}" for key in STAGE),
    *("densify.every", "densify.rules.clone.size_below", "reset_opacity.start"),
    *(f"densify.rules.split.{key}" for key in ("gradient_above", "size_above", "statistic")),
    *LIMITED,
}
MINI = {
    *rules("densify", prune_large="size_above start"),
    *(
        place
        for n in ("", "~2", "~3")
        for place in rules(f"densify{n}", prune_useless="weight_total weight_per_view start views views_below")
    ),
    *(f"densify~{n}.{key}" for n in (2, 3) for key in STAGE),
    *(f"hide_useless{n}.{key}" for n in ("", "~2") for key in ("every", "weight_per_view", "start", "stop")),
    *("densify.every", "densify.start", "densify.stop"),
    *(f"reset_opacity.{key}" for key in ("every", "stop", "when_background")),
    *(f"reset_opacity~2.{key}" for key in ("every", "start", "stop", "value", "when_background")),
}
LEAST = ("prune_least", "prune_least~2")
MEAN_FILTER = {f"views.transforms.mean_filter{key}" for key in ("", ".width.between", ".width.points")}
MOMENTUM = (".gradient_above", ".growth", ".keep", ".max_added")
DASH = {
    *(f"densify.budget{key}" for key in ("", ".initial_momentum", ".gaussians", *MOMENTUM)),
    *(f"views.resolution{key}" for key in ("", ".every", ".follows", ".largest", ".start", ".until")),
    *(f"rates.means.{key}" for key in ("over", "start", "until")),
    *(f"densify.rules.prune_large{key}" for key in ("", ".size_above", ".start")),
    "densify.stop",
}
HAAR = {f"modules.haar{key}" for key in ("", ".learn", ".rate", ".weight")}
SADDLE = {
    *(f"densify.rules.{rule}{key}" for rule in ("clone", "split") for key in ("", ".start", ".statistic", ".opacity")),
    *(f"densify.rules.{rule}{key}" for rule in ("clone", "split") for key in (".as_many_as", ".gradient_above")),
    *("densify.rules.clone.size_below", "densify.rules.split.size_above"),
    *("densify.rules.split.children", "densify.rules.split.shrink"),
    *(f"densify.rules.split_steepest{key}" for key in ("", ".start", ".eigenvalue_below", ".gradient_above")),
    *(f"densify.rules.split_steepest{key}" for key in (".distance", ".shrink", ".opacity")),
}
CROWDED = {
    *(f"densify.rules.clone_dense{key}" for key in ("", ".start", ".gradient_above", ".size_below")),
    *(f"densify.rules.clone_dense{key}" for key in (".ratio_above", ".jitter", ".cells", ".extremes")),
}
DIFFERENCES = {
    ("splat", "auto"): {
        f"densify.rules.{rule}.{key}" for rule in ("clone", "split") for key in ("gradient_above", "statistic")
    }
    | {f"densify~2.{key}" for key in STAGE}
    | {f"densify~2.rules.prune_redundant{key}" for key in ("", ".start", ".error_rise", ".views")},
    ("splat", "steep"): SADDLE,
    ("splat", "gdgs"): CROWDED,
    ("splat", "mip_splatting"): SMOOTHING | MIP | REFRESH,
    ("mip_splatting", "box"): {"model.screen_filter", "model.screen_filter.variance"},
    ("splat", "mip_splatting_no_3d"): MIP,
    ("mip_splatting", "mip_splatting_no_2d"): {"model.screen_filter.variance"},
    ("splat", "splat_ewa"): {"model.screen_filter", "model.screen_filter.compensate"},
    ("mip_splatting", "mip_splatting_gof"): MATCHING,
    ("splat", "absgs"): {
        *("densify.rules.clone.size_below", "densify.rules.split.size_above"),
        *("densify.rules.split.statistic", "densify.rules.split.gradient_above"),
        *LIMITED,
    },
    ("splat", "fastgs"): FASTGS,
    ("splat", "taming"): {
        *rules("densify", grow_scored="start views", prune_faint="opacity_below start", prune_large="size_above start"),
        *rules("densify", prune_scored="opacity_below share size_above.between size_above.points start views"),
        *("densify.every", "densify.budget", "densify.budget.gaussians"),
    },
    ("splat", "mini"): MINI,
    ("splat", "speedy"): {
        f"{stage}.{key}" for stage in LEAST for key in ("every", "keep", "remove", "score", "start", "stop")
    },
    ("splat", "opti3dgs"): MEAN_FILTER,
    ("splat", "dash"): DASH | {"reset_opacity.stop", "rates.logit_opacity"},
    ("splat_7k", "fast"): {
        *rules("densify~2", prune_useless="weight_total weight_per_view start views views_below"),
        *(f"densify~2.{key}" for key in STAGE),
        *(f"densify.rules.prune_large{key}" for key in ("", ".size_above", ".start")),
        *(f"rates.{key}" for key in ("log_scales", "logit_opacity", "quats", "sh_base", "sh_rest")),
        *(f"rates.means.{key}" for key in ("over", "start", "until")),
        *(f"views.resolution{key}" for key in ("", ".every", ".follows", ".largest", ".start", ".until")),
        *(f"{stage}.{key}" for stage in ("average", "reset_opacity~2") for key in ("every", "start", "stop")),
        *(f"reset_opacity{key}" for key in (".every", ".start", ".stop", ".value", ".when_background")),
        *(
            "reset_opacity~2.value",
            "reset_opacity~2.when_background",
            "raise_sh.every",
            "raise_sh.stop",
            "evaluate.every",
            "steps",
        ),
        *("densify.start", "densify.stop", "stages.init.count", "stages.init.min_points", "stages.init.transparent"),
    },
    ("fast", "surface"): {"losses.min_scale", "losses.min_scale.weight"},
    ("fast", "fast_30k"): {
        *(f"{stage}.every" for stage in ("raise_sh", "densify~2", "average", "evaluate", "checkpoint")),
        *("raise_sh.stop", "densify.stop", "densify~2.stop", "average.start"),
        *(f"rates.{key}" for key in ("log_scales", "logit_opacity", "quats", "sh_base", "sh_rest")),
        *(f"rates.means.{key}" for key in ("over", "start", "until")),
        *(f"densify.rules.split.{key}" for key in ("gradient_above", "size_above", "statistic")),
        *(f"densify~2.rules.prune_useless.{key}" for key in ("weight_total", "weight_per_view")),
        *("densify.rules.clone.size_below", "views.resolution.until", "steps"),
        *("losses.l1.weight", "losses.l2", "losses.l2.weight"),
    },
    ("mip_splatting", "dash_mip"): DASH | {"reset_opacity.stop", "rates.logit_opacity", "refresh_filter.start"},
    ("splat", "auto_opti3dgs"): HAAR,
    ("splat", "micro_splatting"): {
        *(f"densify.rules.split_textured{key}" for key in ("", *SUBDIVIDE, ".texture", ".gradient_above")),
        *(f"densify.rules.split_textured.texture_above.{key}" for key in ("of", "quantile")),
        *(f"densify.rules.split_oversized{key}" for key in ("", *SUBDIVIDE, ".pixels", ".rms_above")),
        *(f"losses.covariance_trace{key}" for key in ("", ".above", ".pixels", ".weight")),
        *("losses.l1.weight", "losses.l2", "losses.l2.weight"),
        *("densify.rules.clone.gradient_above", "densify.rules.split.gradient_above"),
        *(
            f"stages.evaluate~2.{key}"
            for key in ("downscales", "file", "lpips", "lpips_input", "metrics", "max_views", "split")
        ),
    },
    ("micro_splatting", "micro_splatting_v2"): THINNING,
}


def test_recipes_differ_only_as_their_headers_state():
    actual = {pair: changes(*pair) for pair in DIFFERENCES}
    faults = [
        f"{base}-{recipe}: {sorted(places ^ DIFFERENCES[base, recipe])}"
        for (base, recipe), places in actual.items()
        if places != DIFFERENCES[base, recipe]
    ]
    assert not faults, "\n".join(faults)


SHORT = """\
# Small, in 5 steps.
short:
  optimize.steps: 5   # of 10
  optimize.losses.1.weight: 0.1
  optimize.during.0.every: 2
  checkpoint.every: 3
"""


def test_short_pipeline_applies_the_short_values(write, tmp_path):
    (tmp_path / "small.yaml").write_text(f"# Small.\n{SMALL}{SHORT}")
    short = str(tmp_path / "small_7k.yaml")
    values = ("steps=5", "losses.1.weight=0.1", "during.0.every=2", "during.1.every=3")
    expected = load(write(SMALL), ["name=small_7k", *(f"optimize.{value}" for value in values)])
    assert load(short).resolved_settings() == expected.resolved_settings()
    assert load(str(tmp_path / "small.yaml")).resolved_settings() == load(write(SMALL)).resolved_settings()
    edited = copy(short, tmp_path / "mine.yaml").read_text()
    assert edited.startswith("# Small, in 5 steps.\n#\n# Small.\nname: small_7k\n")
    assert edited.endswith("- export\n")


def test_variants_before_other_keys_leave_those_as_they_are(write, tmp_path):
    head, stages = SMALL.split("stages:")
    variants = "# Fast.\ndraft:\n  optimize.steps: 4\n# Slow.\nhigh:\n  optimize.steps: 40\n# Stages.\nstages:"
    (tmp_path / "small.yaml").write_text(head + variants + stages)
    for name, steps in (("small_draft", 4), ("small_high", 40)):
        expected = load(write(SMALL), [f"name={name}", f"optimize.steps={steps}"])
        assert load(str(tmp_path / f"{name}.yaml")).resolved_settings() == expected.resolved_settings()


@pytest.mark.parametrize(
    ("short", "words"),
    [
        ("short:\n  optimize.stepps: 5\n", r"small.yaml:18: short: the pipeline has no key 'optimize.stepps'"),
        ("short:\n  steps: 5\n", r"no key 'steps'"),
        ("short:\n  optimize.during.2.every: 5\n", r"no key 'optimize.during.2.every'"),
        ("short: [1]\n", r"expected a mapping 'short' with values for small_7k.yaml"),
    ],
)
def test_invalid_short_value_is_refused_with_its_location(tmp_path, short, words):
    (tmp_path / "small.yaml").write_text(SMALL + short)
    with pytest.raises(ConfigError, match=words):
        load(str(tmp_path / "small_7k.yaml"))


def test_variant_keys_are_set_keys():
    for name, path in files.shipped_pipelines().items():
        data = read_yaml(path).data
        for key in data.keys() & files.VARIANT_SUFFIXES.keys():
            variant = name + files.VARIANT_SUFFIXES[key]
            overrides = [f"{key_path}={json.dumps(value)}" for key_path, value in data[key].items()]
            assert load(name, [f"name={variant}", *overrides]).resolved_settings() == load(variant).resolved_settings()


def replaced(old: str, new: str) -> str:
    assert old in SMALL
    return SMALL.replace(old, new)


REFUSED = {
    "misspelled key": (
        replaced("weight: 0.8", "wieght: 0.8"),
        r"x.yaml:7: stages\[1\].optimize.losses\[0\].wieght: unknown key 'wieght'; did you mean 'weight'",
    ),
    "misspelled stage": (replaced("- evaluate", "- evalute"), r"no stage named 'evalute'; did you mean 'evaluate'\?"),
    "misspelled loss": (
        replaced("type: dssim", "type: dsim"),
        r"x.yaml:8: stages\[1\].optimize.losses\[1\].*no loss named 'dsim'; did you mean 'dssim'\?",
    ),
    "misspelled rule": (
        replaced("type: clone", "type: clon"),
        r"during\[0\].densify.rules\[0\].*no rule named 'clon'; did you mean 'clone'\?",
    ),
    "misspelled top key": (replaced("name: small", "nam: small"), "unknown key 'nam'; did you mean 'name'"),
    "text for a number": (
        replaced("steps: 10", "steps: 30k"),
        r"x.yaml:5: stages\[1\].optimize.steps: expected a whole number, got '30k'",
    ),
    "quoted number": (replaced("steps: 10", "steps: '10'"), "expected a whole number, got '10'"),
    "fraction for a whole": (replaced("steps: 10", "steps: 10.5"), "expected a whole number, got 10.5"),
    "negative": (replaced("steps: 10", "steps: -1"), "greater than 0, got -1"),
    "infinite": (replaced("weight: 0.8", "weight: .inf"), "expected a number, .*got inf"),
    "a number to reach without an end": (
        replaced("every: 100\n", "every: 100\n            budget: {type: parabola, gaussians: 10}\n"),
        r"'budget' needs 'stop'",
    ),
    "no number to reach": (
        replaced("every: 100\n", "every: 100\n            budget: {type: parabola, gaussians: 0}\n"),
        r"budget.gaussians: expected a value of at least 1",
    ),
    "missing steps": (replaced("      steps: 10\n", ""), "'steps' is missing"),
    "a start outside": (replaced("- evaluate", "- evaluate: {start: 3}"), r"'start' belongs inside optimize.during"),
    "a stop outside": (replaced("- evaluate", "- evaluate: {stop: 3}"), r"'stop' belongs inside optimize.during"),
    "another stage inside": (
        replaced("- init", "- init: {stage: export}"),
        r"x.yaml:3: stages\[0\].init.stage: unknown key 'stage'; remove it",
    ),
    "another stage inside during": (
        replaced("{every: 5}", "{every: 5, stage: evaluate}"),
        r"stages\[1\].optimize.during\[1\].checkpoint.stage: unknown key 'stage'",
    ),
    "no cadence": (replaced("checkpoint: {every: 5}", "checkpoint"), "needs 'every' inside 'during'"),
    "cadence outside": (replaced("- evaluate", "- evaluate: {every: 3}"), r"'every' belongs inside optimize.during"),
    "wrong order": (
        replaced("  - init\n", ""),
        r"stages\[0\] optimize needs 'model', which no earlier stage creates; add init before it",
    ),
    "statistics of a model that was replaced": (
        replaced("- evaluate", "- init\n  - densify: {rules: [clone]}"),
        r"stages\[3\] densify needs 'stats', which stages\[2\] init removes; add optimize in between",
    ),
    "figures of a model that was replaced": (
        replaced("- export", "- init\n  - report"),
        r"stages\[4\] report needs 'metrics', which stages\[3\] init removes",
    ),
    "stage not for during": (replaced("checkpoint: {every: 5}", "init: {every: 5}"), "no stage named 'init'"),
    "duplicate key": (replaced("steps: 10", "steps: 10\n      steps: 20"), r"x.yaml:6: duplicate key"),
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
def test_invalid_pipelines_are_refused(case, write):
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


def test_overrides_change_the_keys_that_they_name(write):
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


def test_unknown_pipeline_suggests_the_nearest():
    with pytest.raises(ConfigError, match="did you mean 'splat'"):
        load("splatt")
    with pytest.raises(ConfigError, match="no such pipeline file"):
        load("nowhere.yaml")


def test_folder_does_not_hide_a_pipeline(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "splat").mkdir()
    assert load("splat").settings.name == "splat"
    with pytest.raises(ConfigError, match=re.escape(f"`clsplat run splat_7k --scene {tmp_path}`")):
        load(str(tmp_path))
    (tmp_path / "pipeline.yaml").write_text(SMALL)
    with pytest.raises(ConfigError, match=r"is a run folder.* `clsplat resume .*` continues"):
        load(str(tmp_path))


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "\udcff"])
def test_impossible_file_names_are_refused(name):
    with pytest.raises(ConfigError):
        load(name)


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


def valid(text: str, schema: Draft202012Validator) -> bool:
    return schema.is_valid(read_yaml_text(text))


@pytest.fixture(scope="module")
def own_schema():
    """The schema of files without plug-ins."""
    return Draft202012Validator(json_schema())


def read_yaml_text(text: str) -> object:
    return YAML(typ="safe").load(text)


def faults_of_schema(path: Path, schema: Draft202012Validator, is_resolved: bool) -> list[str]:
    texts = {"the file": read_pipeline(path)}
    if is_resolved:
        matrix = load_experiment(str(path))
        texts["the resolved file"] = matrix.text if matrix else load(str(path)).text()
    return [f"{path.name}: {what}" for what, text in texts.items() if not valid(text, schema)]


@pytest.mark.usefixtures("without_plugins")
def test_schema_accepts_what_the_loader_accepts(own_schema):
    """Every file, and what the files that stand for all kinds resolve to."""
    faults = [fault for name in SHIPPED for fault in faults_of_schema(shipped(name).path, own_schema, name in KINDS)]
    for path in EXAMPLES.glob("*.yaml"):
        plugin = path.with_suffix(".py")
        if plugin.is_file():
            load_file(plugin)
        schema = Draft202012Validator(json_schema()) if plugin.is_file() else own_schema
        faults += faults_of_schema(path, schema, is_resolved=True)
    assert not faults, "\n".join(faults)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("- init", "- init:"),
        ("{type: clone}", "clone"),
        ("{type: l1, weight: 0.8}", "l1"),
        ("steps: 10", "steps: 10\n      views: {order: shuffle}"),
    ],
)
def test_schema_accepts_bare_names_and_stages_without_settings(old, new, write, own_schema):
    load(write(replaced(old, new)))
    assert valid(replaced(old, new), own_schema)


SCHEMA_REFUSES = {
    "a loss without a type": replaced("type: l1, weight", "weight"),
    "a transform that needs settings": replaced("steps: 10", "steps: 10\n      views: {transforms: [blur]}"),
    "a stage that needs settings": "name: x\nstages: [init, optimize]\n",
    "a stage without settings that it needs": "name: x\nstages: [init, optimize: ]\n",
    "another stage inside": replaced("- init", "- init: {stage: export}"),
    "no cadence, with a name": replaced("checkpoint: {every: 5}", "checkpoint"),
    "no cadence": replaced("checkpoint: {every: 5}", "checkpoint: {}"),
    "no stages": "name: x\n",
    **{case: REFUSED[case][0] for case in ("misspelled key", "misspelled stage", "misspelled loss", "misspelled rule")},
    **{case: REFUSED[case][0] for case in ("misspelled top key", "text for a number", "negative", "missing steps")},
    **{case: REFUSED[case][0] for case in ("stage not for during", "two keys in a stage", "unsafe name")},
}


@pytest.mark.parametrize("case", SCHEMA_REFUSES)
def test_schema_refuses_what_the_loader_refuses(case, write, own_schema):
    with pytest.raises(ConfigError):
        load(write(SCHEMA_REFUSES[case]))
    assert not valid(SCHEMA_REFUSES[case], own_schema)
