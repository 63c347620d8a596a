"""Schedules: one notation for every number that can change over training."""

import math
from pathlib import Path

import pytest

from clsplat.core.errors import ConfigError
from clsplat.core.schedule import Every, at_step
from clsplat.losses.image import L1
from clsplat.pipeline.loading import load

POINTS = [[100, 0.8], [200, 0.4], [300, 4.0]]
STEPS = {"points": POINTS, "between": "steps"}
DECAY = {"initial": 1e-2, "final": 1e-4, "over": 100, "start": 50}


def value_of(schedule: object, step: int) -> float:
    """The weight of a loss with this schedule."""
    return at_step(L1(weight=schedule).weight, step)


def test_number_is_constant():
    assert value_of(0.3, 0) == value_of(0.3, 10**6) == 0.3


@pytest.mark.parametrize("schedule", [POINTS, {"points": POINTS}, {"points": POINTS, "between": "linear"}])
def test_values_between_points_are_linear(schedule):
    at = {0: 0.8, 100: 0.8, 101: 0.796, 199: 0.404, 200: 0.4, 201: 0.436, 299: 3.964, 300: 4.0, 301: 4.0, 9999: 4.0}
    assert [value_of(schedule, step) for step in at] == pytest.approx([*at.values()], rel=1e-12)


def test_step_value_holds_until_the_next():
    at = {0: 0.8, 99: 0.8, 100: 0.8, 101: 0.8, 199: 0.8, 200: 0.4, 201: 0.4, 299: 0.4, 300: 4.0, 301: 4.0, 9999: 4.0}
    assert [value_of(STEPS, step) for step in at] == [*at.values()]


@pytest.mark.parametrize("between", ["linear", "steps"])
def test_single_point_is_a_constant(between):
    schedule = {"points": [[10, 0.7]], "between": between}
    assert [value_of(schedule, step) for step in (0, 10, 11, 500)] == [0.7] * 4


def test_decay_is_exponential_between_its_start_and_its_end():
    shares = {0: 0.0, 49: 0.0, 50: 0.0, 51: 0.01, 100: 0.5, 149: 0.99, 150: 1.0, 9999: 1.0}
    expected = [10 ** (-2 - 2 * share) for share in shares.values()]
    assert [value_of(DECAY, step) for step in shares] == pytest.approx(expected, rel=1e-12)


def test_periodic_value_is_0_at_other_steps():
    curve = Every(every=4, value=0.5)
    assert [curve.at(step) for step in (1, 3, 4, 5, 8, 4000)] == [0, 0, 0.5, 0, 0.5, 0.5]
    assert min(curve.values) == 0


def test_decay_begins_at_once_and_may_grow():
    growing = {"initial": 1.0, "final": 100.0, "over": 4}
    assert [value_of(growing, step) for step in range(6)] == pytest.approx(
        [1, 10**0.5, 10, 10**1.5, 100, 100], rel=1e-12
    )


NOTATION = r"expected a number, points [[step, value], …] with increasing steps, {points, between}, {initial, final, over, start} or {every, value}"  # noqa: E501
ORDER = "expected points [step, value] with increasing steps"


@pytest.mark.parametrize(
    ("schedule", "message"),
    [
        ("[]", ORDER),
        ("[[200, 1.0], [100, 2.0]]", ORDER),
        ("[[100, 1.0], [100, 2.0]]", ORDER),
        ("{points: []}", ORDER),
        ("{points: [[2, 1.0], [1, 2.0]], between: steps}", ORDER),
        ("[[1, 2, 3]]", NOTATION),
        ("[['1', 2.0]]", NOTATION),
        ("'1'", NOTATION),
        ("null", NOTATION),
        ("true", NOTATION),
        (".nan", NOTATION),
        ("{points: [[1, 2.0]], between: curves}", NOTATION),
        ("{initial: 1.0, final: 0.0, over: 10}", NOTATION),
        ("{initial: 1.0, final: 0.1}", NOTATION),
        ("{initial: 1.0, final: 0.1, over: 0}", NOTATION),
        ("{initial: 1.0, final: 0.1, over: 10, stop: 3}", NOTATION),
    ],
)
def test_invalid_schedule_is_explained_in_one_sentence(recipe, schedule, message):
    with pytest.raises(ConfigError) as error:
        load(recipe(loss_weight=schedule))
    text = str(error.value)
    assert "recipe.yaml:13: stages[1].optimize.losses[0].weight: " + message in text
    assert "\n" not in text


RECIPE = """\
name: recipe
stages:
  - init
  - optimize:
      steps: 10
      rates:
        means: {rate_means}
        sh_rest: {rate_sh_rest}
      views:
        resolution: {resolution}
        transforms: [{{type: blur, sigma: {sigma}}}]
      losses:
        - {{type: l1, weight: {loss_weight}}}
        - {{type: covariance_trace, weight: {penalty_weight}}}
      during:
        - densify:
            every: 5
            max_gaussians: {max_gaussians}
            rules:
              - {{type: clone, gradient_above: {gradient_above}, size_below: {size_below}}}
              - {{type: split, size_above: {size_above}}}
              - {{type: split_textured, texture_above: {texture_above}, gradient_above: {texture_gradient_above}}}
              - {{type: split_oversized, rms_above: {rms_above}}}
              - {{type: prune_faint, opacity_below: {opacity_below}}}
              - {{type: merge_neighbors, distance_below: {distance_below}, color_below: {color_below}}}
"""
AT_LEAST_ONE = ("resolution", "max_gaussians")
NOT_NEGATIVE = ("rate_means", "rate_sh_rest", "sigma", "texture_above", "texture_gradient_above")
LARGER_THAN_ZERO = (
    *("gradient_above", "size_below", "size_above", "rms_above", "opacity_below", "distance_below", "color_below"),
)
ANY = ("loss_weight", "penalty_weight")
PLACES = (*AT_LEAST_ONE, *NOT_NEGATIVE, *LARGER_THAN_ZERO, *ANY)


@pytest.fixture
def recipe(tmp_path: Path):
    """Write a pipeline in which every number that may change is 1, but for those that are given."""

    def recipe(**values: str) -> str:
        path = tmp_path / "recipe.yaml"
        path.write_text(RECIPE.format(**{**dict.fromkeys(PLACES, "1.0"), **values}))
        return str(path)

    return recipe


@pytest.mark.parametrize(
    "schedule",
    ["2", "[[0, 4.0], [1000, 1.0]]", "{points: [[0, 2.0], [20, 1]], between: steps}",
     "{initial: 4.0, final: 1.0, over: 30, start: 5}"],
)  # fmt: skip
def test_every_schedule_key_takes_every_notation(recipe, schedule):
    pipeline = load(recipe(**dict.fromkeys(PLACES, schedule)))
    optimize = pipeline.settings.training
    densify = optimize.during[0]
    clone, split, textured, oversized, faint, merge = densify.rules
    values = [
        *(optimize.rates.means, optimize.rates.sh_rest, optimize.views.resolution, optimize.views.transforms[0].sigma),
        *(loss.weight for loss in optimize.losses),
        *(densify.max_gaussians, clone.gradient_above, clone.size_below, split.size_above, textured.texture_above),
        *(textured.gradient_above, oversized.rms_above, faint.opacity_below, merge.distance_below, merge.color_below),
    ]
    assert len(values) == len(PLACES)
    at_25 = {"2": 2, "[": 3.925, "{p": 1, "{i": 4 ** (1 - 20 / 30)}
    expected = next(value for start, value in at_25.items() if schedule.startswith(start))
    assert [at_step(value, 25) for value in values] == pytest.approx([expected] * len(values), rel=1e-12)
    again = Path(recipe()).with_name("again.yaml")
    again.write_text(pipeline.text())
    assert load(str(again)).resolved_settings() == pipeline.resolved_settings()


@pytest.mark.parametrize(
    ("places", "refused", "accepted", "message"),
    [
        (AT_LEAST_ONE, 0.5, 1.0, "expected values at least 1"),
        (NOT_NEGATIVE, -0.5, 0.0, "expected values at least 0"),
        (LARGER_THAN_ZERO, 0.0, 1e-30, "expected values larger than 0"),
    ],
)
def test_bounds_hold_for_every_value_of_a_schedule(recipe, places, refused, accepted, message):
    for place in places:
        for schedule in ("{}", "[[0, 3.0], [10, {}]]", "{{points: [[0, {}], [10, 3.0]], between: steps}}"):
            load(recipe(**{place: schedule.format(accepted)}))
            with pytest.raises(ConfigError) as error:
                load(recipe(**{place: schedule.format(refused)}))
            assert message in str(error.value), (place, schedule)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("place", "value", "more"),
    [
        ("texture_above", "{quantile: 2.0, of: pixels}", " or {every, value}, or {quantile, of}"),
        ("texture_above", "{quantile: 0.5, of: photographs}", ", or {quantile, of}"),
        ("rms_above", "{quantile: 0.5, of: pixels}", " or {every, value}, or {quantile}"),
        ("rms_above", "many", ", or {quantile}"),
    ],
)
def test_threshold_neither_schedule_nor_quantile_is_explained(recipe, place, value, more):
    with pytest.raises(ConfigError) as error:
        load(recipe(**{place: value}))
    assert f".{place}: expected a number, points [[step, value], …] with increasing steps" in str(error.value)
    assert more in str(error.value)
    assert "\n" not in str(error.value)


def test_weights_may_be_negative(recipe):
    for place in ANY:
        load(recipe(**{place: "[[0, -1.0], [10, 2.0]]"}))


def test_decay_has_no_rounding_at_its_ends():
    assert math.isclose(value_of(DECAY, 0), 1e-2, rel_tol=1e-15)
    assert math.isclose(value_of(DECAY, 150), 1e-4, rel_tol=1e-14)
