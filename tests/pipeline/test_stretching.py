"""Recipes with a different number of steps."""

from dataclasses import replace
from itertools import cycle
from pathlib import Path

import pytest

from clsplat.core.schedule import at_step
from clsplat.core.settings import Settings
from clsplat.photos.detail import DetailDivisor
from clsplat.pipeline.file import PipelineFile
from clsplat.pipeline.loading import Pipeline, load
from clsplat.pipeline.stretching import last_edit, stretch, stretch_to_steps, with_steps
from tests.support.pipelines import KINDS, SCHEDULED, flat

STEPS = ("steps", "start", "stop", "over", "until", "every")


def changes(name: str, factor: float) -> dict[str, tuple[object, object]]:
    pipeline = load(name)
    old, new = (
        flat(item.resolved_settings())
        for item in (pipeline, replace(pipeline, settings=stretch(pipeline.settings, factor)))
    )
    assert old.keys() == new.keys()
    return {place: (old[place], new[place]) for place in old if old[place] != new[place]}


def test_stretched_long_recipe_equals_the_short_one():
    """Except for the cadence and the end of growth, which splat_7k sets."""
    new = stretch(load("splat").settings, 7000 / 30000).training
    assert (new.steps, new.rates.means.over) == (7000, 7000)
    raise_sh, densify, reset, white = new.during[:4]
    assert (raise_sh.every, densify.every, densify.start, densify.stop) == (233.334, 23.3334, 116, 3500)
    assert [rule.start for rule in densify.rules] == [0, 0, 0, 700]
    assert (reset.every, reset.stop) == (700.002, 3500)
    assert [step for step in range(1, 7000) if white.is_due(step)] == [116]


@pytest.mark.parametrize("name", KINDS)
def test_only_steps_change_and_all_of_them(name):
    """What acts at multiples of a cadence ends one step after the last; a rate of what is learned falls."""
    result = changes(name, 2.0)
    for place, (old, new) in result.items():
        if isinstance(old, list):
            assert new == [[2 * step, value] for step, value in old], place
        elif place.endswith(".haar.rate"):
            assert new == old / 2
        else:
            assert place.endswith(STEPS), place
            assert new in (2 * old, 2 * old - place.endswith(".stop")), place
    stretchable = [
        place
        for place, value in flat(load(name).resolved_settings()).items()
        if place.endswith((".steps", ".start", ".stop", ".over", ".until")) and isinstance(value, int) and value
    ]
    assert set(stretchable) <= result.keys()


@pytest.mark.parametrize(
    ("name", "factor"),
    list(zip(SCHEDULED[1:], cycle((0.0371, 0.617, 1.9)), strict=False)),  # without smoke, which has few steps as it is
)
def test_stages_that_end_act_equally_often(name, factor):
    settings = load(name).settings
    old, new = settings.training, stretch(settings, factor).training
    for before, after in zip(old.during, new.during, strict=True):
        if before.stop is None or before.every == 1:
            continue
        counts = [
            sum(stage.is_due(step) for step in range(1, training.steps))
            for stage, training in ((before, old), (after, new))
        ]
        assert counts[0] == counts[1], before


def test_per_step_stages_end_at_the_same_fraction():
    new = stretch_to_steps(load("mcmc_7k").settings, 2000).training
    (noise,) = [stage for stage in new.during if stage.stage == "add_noise"]
    assert (noise.every, noise.stop) == (1, 5000 * 2000 // 7000)


@pytest.mark.parametrize(("name", "steps"), [("fast", 1), ("blocks", 2000), ("splat", 7001)])
def test_recipe_has_the_requested_steps(name, steps):
    assert stretch_to_steps(load(name).settings, steps).training.steps == steps


@pytest.mark.parametrize(("name", "factor"), list(zip(SCHEDULED, cycle((0.01, 0.13, 1.0, 3.7)), strict=False)))
def test_every_stretched_recipe_is_valid(name, factor):
    settings = load(name).settings
    new = stretch(settings, factor)
    assert type(settings).model_validate(new.model_dump()) == new
    assert factor != 1 or new == settings


def checked_again(name: str, settings: PipelineFile, folder: Path) -> Pipeline:
    """The pipeline as it is written and read: every stage has what it needs."""
    file = folder / "again.yaml"
    file.write_text(replace(load(name), settings=settings).text())
    return load(str(file))


@pytest.mark.parametrize("steps", [340, 5000])
def test_stretched_average_starts_at_the_same_fraction(tmp_path, steps):
    settings = load("fast").settings
    new = checked_again("fast", stretch_to_steps(settings, steps), tmp_path).settings.training
    assert new == stretch_to_steps(settings, steps).training
    (average,) = [stage for stage in new.during if stage.stage == "average"]
    assert average.start == 2000 * steps // 3400
    assert sum(average.is_due(step) for step in range(1, steps)) == 27


@pytest.mark.parametrize(
    ("name", "done", "left"),
    [
        *(("fast", 900, 2), ("fast", 1700, 50), ("fast", 2500, 900), ("fast", 900, 9000)),
        *(("splat_7k", 1700, 2), ("splat_7k", 2500, 50), ("splat_7k", 900, 900), ("splat_7k", 2500, 9000)),
    ],
)
def test_corrected_step_count_keeps_later_stages(tmp_path, name, done, left):
    """And what was done: a stage that had begun acts at the same steps."""
    settings = load(name).settings
    new = checked_again(name, with_steps(settings, done + left, done), tmp_path).settings.training
    assert new.steps == done + left
    for before, after in zip(settings.training.during, new.during, strict=True):
        for step in range(1, done + 1):
            assert before.is_due(step) == after.is_due(step)
        assert before.start <= done or done < after.start + 1 < new.steps


@pytest.mark.parametrize("name", SCHEDULED)
def test_corrected_count_is_after_growth_and_small_photographs(name):
    training = load(name).settings.training
    last, resolution = last_edit(training), training.views.resolution
    assert last <= training.steps
    is_fixed = not isinstance(resolution, DetailDivisor)
    assert at_step(resolution, last) == at_step(resolution, training.steps) if is_fixed else last >= resolution.until
    grows = [stage for stage in training.during if stage.stage == "densify" and stage.stop]
    assert not any(stage.is_due(step) for stage in grows for step in range(last, training.steps))


def test_detail_schedule_is_not_cut_before_full_size():
    assert last_edit(load("dash_7k").settings.training) == 6300


def test_rate_of_modules_scales_with_their_updates():
    (haar,) = stretch_to_steps(load("auto_opti3dgs").settings, 7000).training.modules
    (short,) = load("auto_opti3dgs_7k").settings.training.modules
    assert haar.rate == pytest.approx(1e-4 * 30 / 7)
    assert short.rate == pytest.approx(haar.rate, rel=0.01)
    (points,) = stretch([haar.model_copy(update={"rate": [[0, 1e-3], [100, 1e-4]]})], 0.5)
    assert points.rate == [[0, 2e-3], [50, 2e-4]]


def test_never_is_a_number_that_yaml_can_store():
    never = load("splat_7k", [f"densify.stop={2**63 - 1}"]).settings
    assert stretch(never, 3.0).training.during[1].stop == 2**63 - 1
    assert stretch(load("splat_7k", ["densify.every=9e18"]).settings, 3.0).training.during[1].every == 2**63 - 1


def test_coinciding_schedule_points_merge():
    class Holder(Settings):
        values: list[list[float]]

    assert stretch(Holder(values=[[0, 1.0], [10, 2.0], [14, 3.0]]), 0.1).values == [[0, 1.0], [1, 3.0]]
