"""Edits keep their order and distance if a recipe is stretched."""

import functools
import math
from fractions import Fraction
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import fire_steps, fires_at
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import load
from clsplat.pipeline.stretching import StepScaling, last_edit, min_steps, stretch_to_steps, with_steps
from clsplat.training.stage import Training
from tests.support.pipelines import SCHEDULED


def edits(training: Training, recipe: Training) -> list[tuple[int, int]]:
    """The step and the place in the list of each edit, but for those that the recipe makes at each step, in order; the
    size of photographs that follows from their detail changes before all."""
    actual = [(int(step), -1) for step in training.views.changes]
    for place, stage in enumerate(training.during):
        if stage.edits and recipe.during[place].every != 1:
            actual += [(step, place) for step in range(1, training.steps) if stage.is_due(step)]
    return sorted(actual)


@functools.cache
def recipe_and_edits(name: str) -> tuple[PipelineFile, list[tuple[int, int]]]:
    recipe = load(name).settings
    return recipe, edits(recipe.training, recipe.training)


@pytest.mark.parametrize("name", SCHEDULED)
@settings(max_examples=3)
@given(data=st.data())
def test_edits_keep_order_and_distance_in_any_number_of_steps(name, data):
    """As many of each kind, in the same order; those at one step stay at one, no others come to be."""
    recipe, old = recipe_and_edits(name)
    fewest, steps = min_steps(recipe.training), recipe.training.steps
    new = edits(stretch_to_steps(recipe, data.draw(st.integers(fewest, 2 * steps))).training, recipe.training)
    assert [place for _, place in new] == [place for _, place in old]
    for before, after in zip(pairwise(old), pairwise(new), strict=True):
        assert (before[0][0] == before[1][0]) == (after[0][0] == after[1][0]), (before, after)


@pytest.mark.parametrize("name", ["fast", "dash_7k", "smoke"])
@settings(max_examples=3)
@given(data=st.data())
def test_stretched_pipeline_stretches_again_with_its_own_edits(name, data):
    """Also that of a run in minutes, whose cadences are not whole.  In the fewest steps a cadence may become 1, which
    means each step in any number of them."""
    recipe, old = recipe_and_edits(name)
    fewest, steps = min_steps(recipe.training) + 1, recipe.training.steps
    between = stretch_to_steps(recipe, data.draw(st.integers(fewest, 2 * steps)))
    new = edits(stretch_to_steps(between, data.draw(st.integers(fewest, 2 * steps))).training, recipe.training)
    assert [place for _, place in new] == [place for _, place in old]


@pytest.mark.parametrize("name", ["fast", "dash", "smoke"])
@settings(max_examples=3)
@given(data=st.data())
def test_in_fewer_steps_edits_coincide_but_keep_their_order(name, data):
    recipe, old = recipe_and_edits(name)
    steps = data.draw(st.integers(1, min_steps(recipe.training)))
    factor = StepScaling.from_factor(Fraction(steps, recipe.training.steps)).factor
    old, new = (
        {(step, place) for step, place in item if place != -1}  # at least one change of the size stays
        for item in (old, edits(stretch_to_steps(recipe, steps).training, recipe.training))
    )
    assert new == {(math.floor(step * factor), place) for step, place in old if step * factor >= 1}


@pytest.mark.parametrize("steps", [1, 200])
def test_averaging_starts_after_growth_even_in_few_steps(steps):
    """It began before in 200 steps: 40 cadences of 2.9 steps, each cut to 2, end sooner than 2 of 47."""
    training = stretch_to_steps(load("fast").settings, steps).training
    last = [max([0, *(n for n in range(1, steps) if stage.is_due(n))]) for stage in training.during]
    (average,) = [stage for stage in training.during if stage.stage == "average"]
    assert all(
        average.start >= step for step, stage in zip(last, training.during, strict=True) if stage.stage == "densify"
    )


def test_fractional_cadence_fires_at_or_below_its_multiples():
    assert fire_steps(2.5, 0, 13) == [2, 5, 7, 10, 12] == [step for step in range(1, 13) if fires_at(2.5, step)]
    assert fire_steps(2.5, 5, 12) == [7, 10]
    assert fire_steps(5.8824, 90, 101) == [94, 100]
    assert [step for step in range(1, 30) if fires_at(10, step)] == fire_steps(10, 0, 30) == fire_steps(10.0, 0, 30)


def test_cadence_below_a_step_is_refused():
    with pytest.raises(ConfigError, match="expected a number of steps of at least 1; fractions are allowed"):
        load("splat_7k", ["densify.every=0.5"])
    assert load("splat_7k", ["densify.every=2.94"]).settings.training.during[1].every == 2.94


@pytest.mark.parametrize("name", SCHEDULED)
@settings(max_examples=3)
@given(data=st.data())
def test_corrected_step_count_keeps_all_up_to_the_last_edit(name, data):
    """Whatever starts after the last edit, such as an average, still does."""
    recipe, old = recipe_and_edits(name)
    last = last_edit(recipe.training)
    done = data.draw(st.integers(1, recipe.training.steps - 1))
    steps = data.draw(st.integers(max(done, last) + 2, 2 * recipe.training.steps + 2))
    new = edits(with_steps(recipe, steps, done).training, recipe.training)
    fixed = min(max(done, last), recipe.training.steps - 1)
    assert [edit for edit in new if edit[0] <= fixed] == [edit for edit in old if edit[0] <= fixed]
