"""Settings that may change on resume, as declared by classes, also in plug-ins."""

from typing import ClassVar, Literal

import pytest

from clsplat.core.settings import rebuild_models, resume_effect, variants
from clsplat.pipeline.loading import check_document
from clsplat.pipeline.overrides import CADENCE
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.stages.evaluate import Evaluate
from clsplat.training import stage as base
from clsplat.training.settings_diff import differences, first_difference
from clsplat.training.stage import Scheduled, Stage


def kinds(before, after) -> dict[str, str | None]:
    """The kind of each difference between two pipelines, by place."""
    result = differences(before.resolved_settings(), after.resolved_settings(), after.settings)
    return {difference.key_path: difference.kind for difference in result}


@pytest.fixture
def pipeline(tmp_path):
    """A function from the text of stages to a checked pipeline, and overrides of it."""
    file = tmp_path / "pipeline.yaml"

    def made(stages: str, *overrides: str):
        file.write_text(f"name: changes\nstages:{stages}")
        return check_document(file, read_yaml(file), overrides)

    return made


TRAINING = """
- init: {count: 50, source: random}
- optimize:
    steps: 10
    losses: [l1, {type: anisotropy, above: 5}]
    during:
    - densify: {every: 5, rules: [{type: clone}, {type: split_oversized, pixels: 2}]}
    - evaluate: {every: 5}
- evaluate
- export
"""
CHANGES = {
    "scene.image_budget=7": "output",
    "optimize.log_every=7": "output",
    "optimize.evaluate.every=7": "output",
    "stages.2.downscales=[2]": "output",
    "export.file=other.ply": "output",
    "optimize.steps=20": "training",
    "optimize.rates.quats=1e-4": "training",
    "optimize.rates.means=1e-4": "training",
    "optimize.losses.1.weight=[[3, 0.0], [4, 0.1]]": "training",
    "optimize.densify.every=7": "training",
    "optimize.densify.max_gaussians=100": "training",
    "optimize.densify.rules.0.start=3": "training",
    "optimize.densify.rules.0.gradient_above=1e-3": "training",
    "optimize.densify.rules.0.size_below=0.1": "training",
    "optimize.densify.rules.1.beta=0.25": "training",
    "optimize.densify.rules.1.pixels=3": None,  # a table depends on it
    "optimize.densify.rules.0.statistic=screen_grad_abs": None,
    "optimize.densify.rules=[clone]": None,
    "optimize.losses.1.above=6": None,
    "optimize.losses=[l1]": None,
    "optimize.views.order=shuffle": None,
    "init.count=60": None,
    "seed=1": None,
    "model.sh_degree=1": None,
    "scene.downscale=2": None,
}


def test_class_declares_which_keys_may_change(pipeline):
    actual = {change: set(kinds(pipeline(TRAINING), pipeline(TRAINING, change)).values()) for change in CHANGES}
    faults = [f"{change}: {kind}" for change, kind in actual.items() if kind != {CHANGES[change]}]
    assert not faults, "\n".join(faults)


def test_plugin_stage_declares_which_keys_may_change(pipeline, without_plugins):
    class Shake(Scheduled):
        stage: Literal["shake"] = "shake"
        training_keys: ClassVar[frozenset[str]] = frozenset({"strength"})
        output_keys: ClassVar[frozenset[str]] = frozenset({"remark"})

        strength: float = 1.0
        remark: str = ""
        steps: int = 3

        def run(self, run) -> None: ...

    rebuild_models()
    stages = TRAINING.replace("- evaluate: {every: 5}", "- shake: {every: 5}")
    before = pipeline(stages)
    for change, kind in {
        "strength=2.0": "training",
        "every=6": "training",
        "remark=a": "output",
        "steps=4": None,
    }.items():
        after = pipeline(stages, f"optimize.shake.{change}")
        assert set(kinds(before, after).values()) == {kind}, change
    assert set(kinds(pipeline(TRAINING), before).values()) == {None}, "another stage in the place of one"


def test_stages_that_only_read_the_model_may_change_entirely():
    for name in ("evaluate", "export", "render", "report", "checkpoint"):
        kind = variants(Stage)[name]
        assert {resume_effect(kind, key) for key in kind.model_fields if key != "stage"} == {"output"}, name
    assert Evaluate.output_keys > base.CADENCE == frozenset(CADENCE)


def test_first_difference_is_named_by_its_key():
    old = {"a": 1, "b": {"c": [1, {"d": 2}]}}
    assert first_difference(old, old) is None
    assert str(first_difference(old, {"a": 1, "b": {"c": [1, {"d": 3}]}})) == "b.c[1].d was 2, is 3"
    assert first_difference(old, {"a": 1}) is not None
