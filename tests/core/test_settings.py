"""Variants: available once their class is defined, given as a name or a mapping, and suggested if misspelled."""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest

from clsplat.core.errors import ConfigError
from clsplat.core.settings import OneOf, Settings, descriptions, rebuild_models, variant_tag, variants
from clsplat.density.edit import Edit, Rule
from clsplat.losses.base import ImageLoss, Loss, Penalty
from clsplat.photos.sampling import Order, ShuffleOrder
from clsplat.photos.transforms import PhotographTransform
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.recipes import json_schema
from clsplat.training.run import Run
from clsplat.training.stage import Scheduled, Stage

PIPELINE = """\
name: small
stages:
  - init
  - optimize:
      steps: 10
      views: {views}
      losses: {losses}
      during:
        - densify: {{every: 5, rules: {rules}, budget: {budget}}}
"""


@pytest.fixture
def loaded(tmp_path: Path):
    def loaded(views: str = "{}", losses: str = "[l1]", rules: str = "[clone]", budget: str = "null") -> Pipeline:
        path = tmp_path / "small.yaml"
        path.write_text(PIPELINE.format(views=views, losses=losses, rules=rules, budget=budget))
        return load(str(path))

    return loaded


@pytest.fixture
def forget_variants(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Remove the variants that a test defines."""
    load("smoke")  # the first pipeline of a process makes all variants known that there are
    with monkeypatch.context() as patch:
        patch.setattr(Settings, "subclasses", list(Settings.subclasses))
        yield
    rebuild_models()


def test_variants_are_the_subclasses_with_a_name():
    images = {"inverse_depth", "l1", "l2", "dssim"}
    penalties = {"covariance_trace", "anisotropy", "mean_scale", "min_scale", "mean_opacity", "opacity_pressure"}
    assert variants(Loss).keys() == images | penalties
    assert variants(Loss).keys() == variants(ImageLoss).keys() | variants(Penalty).keys()
    assert variants(Order)["shuffle"] is ShuffleOrder
    assert variant_tag(ShuffleOrder) == ("type", "shuffle")
    assert variant_tag(Order) is None, "a base is no variant"
    assert {"densify", "evaluate", "checkpoint"} <= variants(Scheduled).keys() < variants(Stage).keys()


@pytest.mark.usefixtures("forget_variants")
def test_variant_defined_later_is_known_after_a_rebuild(loaded):
    class Thin(Rule):
        """Remove every n-th Gaussian."""

        type: Literal["thin"] = "thin"
        nth: int = 2
        """Which."""

        def mark(self, edit: Edit) -> None:
            pass

    assert variants(Rule)["thin"] is Thin
    with pytest.raises(ConfigError, match="no rule named 'thin'"):
        loaded(rules="[thin]")
    rebuild_models()
    assert loaded(rules="[{type: thin, nth: 3}]").settings.training.during[0].rules == [Thin(nth=3)]
    assert "Thin" in json_schema()["$defs"]


@pytest.mark.usefixtures("forget_variants")
def test_nested_variants_are_known_in_any_definition_order(tmp_path):
    class Apply(Stage):
        """Apply a rule."""

        stage: Literal["apply"] = "apply"
        rule: OneOf[Rule]
        """Which."""

        def run(self, run: Run) -> None:
            pass

    rebuild_models()

    class Thin(Rule):
        type: Literal["thin"] = "thin"

        def mark(self, edit: Edit) -> None:
            pass

    rebuild_models()
    (tmp_path / "apply.yaml").write_text("name: apply\nstages: [{apply: {rule: thin}}]\n")
    assert load(str(tmp_path / "apply.yaml")).stages == [Apply(rule=Thin())]


@pytest.mark.usefixtures("forget_variants")
def test_two_variants_of_one_name_are_refused():
    class Other(Order):
        type: Literal["shuffle"] = "shuffle"

    with pytest.raises(ConfigError) as error:
        variants(Order)
    assert str(error.value) == (
        "two variants of Order have the name 'shuffle': "
        "clsplat.photos.sampling.ShuffleOrder and tests.core.test_settings.Other; "
        "rename one"
    )


def test_bare_name_means_the_variant_with_defaults(loaded):
    words = loaded("{order: shuffle}", "[l1, dssim]", "[clone, prune_faint]")
    mappings = loaded("{order: {type: shuffle}}", "[{type: l1}, {type: dssim}]", "[{type: clone}, {type: prune_faint}]")
    assert words.resolved_settings() == mappings.resolved_settings()
    assert (
        words.resolved_settings() != loaded("{order: stack}", "[l1, dssim]", "[clone, prune_faint]").resolved_settings()
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rules": "[clone, splitt]"}, "small.yaml:9: stages[1].optimize.during[0].densify.rules[1]: no rule named "
         "'splitt'; did you mean 'split'?"),
        ({"rules": "[{type: splitt}]"}, "no rule named 'splitt'; did you mean 'split'?"),
        ({"losses": "[disim]"}, "small.yaml:7: stages[1].optimize.losses[0]: no loss named 'disim'; did you mean "
         "'dssim'?"),
        ({"losses": "[xyz]"}, "no loss named 'xyz'; expected one of anisotropy, covariance_trace, dssim, "
         "inverse_depth, l1, l2"),
        ({"views": "{order: shufle}"}, "small.yaml:6: stages[1].optimize.views.order: no order named 'shufle'; did you "
         "mean 'shuffle'?"),
        ({"views": "{transforms: [blurr]}"}, "no photograph transform named 'blurr'; did you mean 'blur'?"),
        ({"views": "{order: 3}"}, "stages[1].optimize.views.order: "),
        ({"views": "{order: {}}"}, "stages[1].optimize.views.order: expected a 'type', the name of the order"),
        ({"views": "{order: {type: shuffle, share: 1}}"}, "optimize.views.order.share: unknown key 'share'"),
        ({"budget": "{gaussians: 1}"}, "small.yaml:9: stages[1].optimize.during[0].densify.budget: expected a "
         "'type', the name of the budget"),
        ({"budget": "parabol"}, "no budget named 'parabol'; did you mean 'parabola'?"),
        ({"views": "{oder: shuffle}"}, "unknown key 'oder'; did you mean 'order'?"),
        ({"views": "{transforms: [blur]}"}, "'sigma' is missing"),
        ({"rules": "[{type: clone, statistic: screen_grat}]"}, "rules[0].statistic: expected "),
    ],
)  # fmt: skip
def test_unknown_variant_is_explained_in_one_line(loaded, settings, message):
    with pytest.raises(ConfigError) as error:
        loaded(**settings)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_every_variant_has_a_description():
    """Its docstring is its manual, and so are those of its fields."""
    for base in (Stage, Loss, Rule, Order, PhotographTransform):
        for name, kind in variants(base).items():
            assert kind.__doc__, name
            for key in kind.model_fields:
                assert key in ("stage", "type", *descriptions(kind)), f"{name}.{key} has no docstring"


@pytest.mark.parametrize("key", ["screen_filter.variance", "near"])
def test_value_beyond_the_format_is_refused_before_training(key):
    with pytest.raises(ConfigError, match=key.rpartition(".")[2]):
        load("smoke", [f"model.{key}=1e38"])
    load("smoke", [f"model.{key}=1e14"])
