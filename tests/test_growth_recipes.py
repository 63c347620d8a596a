"""Recipes whose edits look at training views: in a short form they grow, prune, and go on with the same bits."""

from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from clsplat.errors import Interrupted
from clsplat.pipeline.loading import load
from clsplat.runs import opening, runner
from clsplat.training.run import Progress, Run
from tests.test_training import digest, train

pytestmark = pytest.mark.slow

RECIPES = ("fastgs_7k", "speedy_7k", "mini_7k", "taming_7k")
SHARE = 250  # of the steps
STEPS = frozenset({"steps", "every", "start", "stop", "over"})


def shortened(value: Any) -> Any:
    """Settings with fewer steps: those of a cadence are at least one."""
    if isinstance(value, list):
        return [shortened(item) for item in value]
    if not isinstance(value, dict):
        return value
    if "points" in value:
        return {**value, "points": [[step // SHARE, number] for step, number in value["points"]]}
    return {
        key: max(int(key != "start"), round(inner / SHARE)) if key in STEPS and inner else shortened(inner)
        for key, inner in value.items()
    }


@pytest.fixture(params=RECIPES)
def recipe(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The file of a recipe in 28 steps, which are too few for a reset of the opacity, without what follows them."""
    settings = shortened(load(request.param).resolved())
    stages = {next(iter(stage)): stage for stage in settings["stages"]}
    training = stages["optimize"]["optimize"]
    training["during"] = [stage for stage in training["during"] if stage.get("reset_opacity", {}).get("to") != 0.01]
    settings["stages"] = [stages[name] for name in ("init", "optimize", "export")]
    path = tmp_path / f"{request.param}.yaml"
    YAML(typ="safe").dump(settings, path)
    return str(path)


def test_growth_along_the_parabola_ends_at_the_number_and_not_above(tiny_scene, tmp_path):
    """Every Gaussian may grow at each of the five edits, 10 to 30, of which the draws take as many as the curve has."""
    settings = [
        *(
            "optimize.steps=40",
            "init.source=random",
            "init.count=100",
            "densify.every=5",
            "densify.start=5",
            "densify.stop=31",
        ),
        *("densify.budget={type: parabola, gaussians: 300}", "optimize.evaluate.every=100", "reset_opacity.every=1000"),
        "densify.rules=[{type: clone, gradient_above: 1.0e-12, size_below: 100.0}, {type: grow_scored, views: 3}]",
    ]
    edits = train(tiny_scene, tmp_path / "run", *settings).records.read("densify")
    assert [edit["after"] for edit in edits] == [172, 228, 268, 292, 300]


def test_a_recipe_repeats_and_goes_on_with_the_same_bits(recipe, tiny_scene, tmp_path):
    overrides = ("init.count=200", "init.opacity=0.3", "model.sh_degree=1")
    whole = train(tiny_scene, tmp_path / "whole", *overrides, pipeline=recipe)
    edits = whole.records.read("densify")
    assert any(edit["after"] > edit["before"] for edit in edits)
    removed = sum(number for edit in edits for cause, number in edit["causes"].items() if cause.startswith("prune"))
    assert removed > 0 or "taming" in recipe, "none is faint, so soon"
    checked = load(recipe, [f"scene.path='{tiny_scene}'", *overrides, "optimize.log_every=1"])
    for stop_at in (16,):
        run = opening.open_run(checked, tmp_path / "parts", None)

        def stop(progress: Progress, run: Run = run, stop_at: int = stop_at) -> None:
            run.interrupted = progress.step >= stop_at

        with pytest.raises(Interrupted):
            runner.execute(checked, run, "resume", stop)
    train(tiny_scene, tmp_path / "parts", *overrides, pipeline=recipe, resume=True)
    assert digest(tmp_path / "parts") == digest(whole.out)
