"""`--set`: its keys, and its errors."""

import pytest

from clsplat.core.errors import ConfigError, OverrideError
from clsplat.pipeline.loading import load
from clsplat.pipeline.overrides import list_keys
from tests.support.pipelines import KINDS


@pytest.mark.parametrize("name", KINDS)
def test_every_listed_key_can_be_set_to_its_listed_value(name):
    pipeline = load(name)
    keys = list_keys(pipeline.settings)
    assert len({key.key_path for key in keys}) == len(keys)
    listed = {**pipeline.resolved_settings(), "adapt": None}  # which keeps keys that are set
    together = [key.text for key in keys]
    for overrides in (together, together[::-1]):  # one that changes another key is seen in one of the orders
        assert {**load(name, overrides).resolved_settings(), "adapt": None} == listed, overrides


def test_listed_keys_have_an_effect():
    before = load("micro_splatting_v2")
    places = {key.key_path: key for key in list_keys(before.settings)}
    assert {"seed", "scene.downscale", "init.opacity", "optimize.steps", "raise_sh.every"} <= set(places)
    assert "densify.every" not in places, "there are three of them"
    changed = load("micro_splatting_v2", ["optimize.during.2.every=7"])
    assert {key.key_path for key in list_keys(changed.settings) if key.value != places[key.key_path].value} == {
        "optimize.during.2.every"
    }


def test_default_left_out_of_the_file_can_be_changed_in_part():
    model = load("smoke", ["model.screen_filter.variance=0.5", "scene.downscale=2"]).settings.model
    assert (model.screen_filter.type, model.screen_filter.variance) == ("dilation", 0.5)
    model = load("smoke", ["model.screen_filter.type=mip"]).settings.model
    assert (model.screen_filter.variance, model.screen_filter.compensate) == (0.1, 1), "the defaults of mip"


REFUSED = {
    "optimize.steps=abc": "expected a whole number, got 'abc'",
    "optimize.stps=5": "unknown key 'stps'; did you mean 'steps'?",
    "seed=-1": "expected a value of at least 0, got -1",
    "scene.levels=20": "expected a value of at most 8, got 20",
    "evaluate.downscales=[1,a]": "stages[2].evaluate.downscales[1]: expected a number, got 'a'",
    "model.screen_filter.type=dilate": "no screen filter named 'dilate'; did you mean 'dilation'?",
    "optimize.every=3": "unknown key 'every'; did you mean 'log_every'?",
    "export.every=3": "stages[3] export: 'every' belongs inside optimize.during",
    "init.count.x=3": "'count' has no keys",
    "optimize.losses.0={type: 3}": "no loss named '3'",
    "steps=100": "no key 'steps' at the top level of a pipeline; did you mean optimize.steps?",
    "max_gaussians=9": "no key 'max_gaussians' at the top level of a pipeline; did you mean densify.max_gaussians?",
    "rates.means.start=1": "no 'rates' in this pipeline; did you mean optimize.rates.means.start?",
    "optimze.steps=5": "no 'optimze' in this pipeline; did you mean optimize.steps?",
    "optimize.losses.9.weight=1": "expected an index below 2 in a list of 2, got '9'; did you mean",
    "optimize.losses.²=1": "expected an index below 2 in a list of 2, got '²'",
    "optimize.steps": "expected KEY=VALUE",
    "=3": "expected KEY=VALUE",
    "optimize.steps=!!float x": "cannot read the value: 'x' cannot be read as float",
    "optimize.steps=!!python/object/apply:os.system ['x']": "cannot read the value: the tag !!python",
    "optimize.steps=&a [*a]": "cannot read the value: ",
    "optimize.steps=[": "cannot read the value: ",
    "name=../up": "expected text that matches",
    "stages=[int]": "stages[0]: no stage named 'int'; did you mean 'init'?",
    "plugins.a=b": "'plugins' cannot be set; runs write it; load a plug-in with --plugin FILE",
    "optimize.during=[{every: 3}, {to: 1, every: 3}]": "expected a 'stage', the name of the stage",
    "optimize.losses=[{weight: 3}]": "expected a 'type', the name of the loss",
    "densify.budget={gaussians: 1}": "expected a 'type', the name of the budget",
    "densify.budget.gaussians=40000": "expected a 'type', the name of the budget",
    "densify.budget={type: parabol}": "no budget named 'parabol'; did you mean 'parabola'?",
    "model.world_filter={type: none, variance: 1}": "unknown key 'variance'; remove it: no keys are allowed here",
    "stages=3": "expected a list, got 3",
}


INSIDE = {  # paths that leave the run folder, or name another of its files
    "export.file": ("../../escaped.ply", "/escaped.ply", "C:/escaped.ply", "a/../../b.ply", "pipeline.yaml", "ply"),
    "report.file": ("../report.html", "metrics.json"),
    "render.folder": ("../renders", "/renders"),
}


@pytest.mark.parametrize("place", INSIDE)
def test_outputs_stay_inside_the_run_folder(place):
    for path in INSIDE[place]:
        with pytest.raises(OverrideError, match=f"cannot write to this path.*, got '{path}'"):
            load("splat_7k", [f"{place}={path}"])


@pytest.mark.parametrize("override", REFUSED)
def test_error_in_set_names_only_set(override):
    with pytest.raises(OverrideError) as error:
        load("smoke", ["optimize.log_every=5", override, "init.count=9"])
    message = str(error.value)
    assert message.startswith("--set ")
    assert REFUSED[override] in message
    assert ".yaml" not in message
    assert "\n" not in message


def test_too_deep_key_is_refused():
    with pytest.raises(OverrideError, match=r"expected KEY=VALUE"):
        load("smoke", ["optimize." + "x." * 1000 + "y=1"])


def test_long_values_are_shortened():
    for override in ("optimize.steps=" + "9" * 5000, "stages[" + "9" * 5000 + "]=1", "name=" + "a b" * 5000):
        with pytest.raises(OverrideError) as error:
            load("smoke", [override])
        assert len(str(error.value)) < 1000


def test_stages_of_equal_name_are_numbered():
    with pytest.raises(
        OverrideError, match=r"3 stages are named 'densify'; use stages\.1\.during\.1 or stages\.1"
    ) as error:
        load("micro_splatting_v2", ["densify.every=3"])
    for place in ("stages.1.during.1", "optimize.during.1"):
        assert place.rpartition(".")[2] in str(error.value)
        load("micro_splatting_v2", [f"{place}.every=3"])


def test_error_in_the_file_names_the_file_despite_set(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nstages:\n  - init: {cuont: 3}\n")
    with pytest.raises(ConfigError, match=r"x.yaml:3: stages\[0\].init.cuont: unknown key 'cuont'"):
        load(str(path), ["seed=3"])


def test_set_can_complete_a_file(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nstages:\n  - init\n  - optimize: {losses: [{type: l1}]}\n")
    assert load(str(path), ["optimize.steps=3"]).settings.training.steps == 3


def test_bare_names_in_a_file_can_be_changed_below(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(
        "name: x\nstages:\n  - init\n  - optimize:\n      steps: 3\n      losses: [l1]\n      views: {order: stack}\n"
        "      during: [{densify: {every: 2, rules: [prune_faint]}}]\n"
    )
    settings = load(str(path), ["optimize.losses[0].weight=0.5", "densify.rules.0.start=7"]).settings.training
    assert (settings.losses[0].type, settings.losses[0].weight) == ("l1", 0.5)
    assert settings.during[0].rules[0].start == 7
    assert load(str(path), ["optimize.views.order.type=shuffle"]).settings.training.views.order.type == "shuffle"


def test_value_may_use_file_notation():
    during = load("smoke", ["optimize.during=[{checkpoint: {every: 3}}, raise_sh]", "raise_sh.every=4"])
    assert [(stage.stage, stage.every) for stage in during.settings.training.during] == [
        ("checkpoint", 3),
        ("raise_sh", 4),
    ]
    stages = "stages=[init, {optimize: {steps: 3, losses: [l1], during: [{checkpoint: {every: 3}}]}}]"
    assert load("smoke", [stages, "checkpoint.every=5"]).settings.training.during[0].every == 5
