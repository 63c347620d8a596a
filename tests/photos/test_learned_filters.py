"""Photographs that a filter changes which is learned, in whole runs: what is refused, what repeats."""

import pytest

from clsplat.core.errors import ConfigError
from clsplat.losses.host import HostLoss
from clsplat.pipeline.loading import load
from tests.support.runs import train

NUMBERS = {"haar/scale", "haar/leak"}


def test_a_transform_after_one_that_learns_is_refused():
    after = "optimize.views.transforms=[{type: haar}, {type: blur, sigma: 1.0}]"
    with pytest.raises(
        ConfigError, match="a transform follows 'haar', which learns; expected one that learns at the end"
    ):
        load("smoke", [after])
    with pytest.raises(ConfigError, match="a transform follows 'haar'"):
        load("smoke", ["optimize.views.transforms=[haar, haar]"])
    load("smoke", ["optimize.views.transforms=[{type: blur, sigma: 1.0}, haar]"])


def test_a_loss_that_is_not_symmetric_is_refused_before_a_run():
    training = load("smoke", ["optimize.views.transforms=[haar]"]).settings.training
    training.check()
    other = HostLoss(lambda image, photograph: (0.0, image))
    with pytest.raises(ConfigError, match="the loss '<lambda>', where 'haar' learns"):
        training.model_copy(update={"losses": [*training.losses, other]}).check()


@pytest.mark.parametrize("recipe", ["auto_opti3dgs_7k"])
def test_filter_follows_the_same_course_in_its_share_of_steps(recipe):
    """By its own loss: from the mean of squares to the photograph, long before the end."""
    training = load(recipe).settings.training
    (haar,) = training.views.transforms
    numbers, course = {}, {}
    for step in range(1, training.steps + 1):
        haar.update(numbers, haar.penalty(haar.now(numbers), step)[1], step)
        course[step] = numbers["haar/scale"]
    assert [course[training.steps * n // 100] for n in (5, 10, 20)] == pytest.approx([0.145, 0.28, 0.53], abs=0.03)
    assert course[training.steps * 6 // 10] == pytest.approx(1, abs=0.03)


@pytest.mark.slow
def test_the_recipe_trains(tiny_scene, tmp_path):
    """The filter leaves zero at its rate, and measured is what photographs are."""
    short = ("optimize.steps=30", "optimize.evaluate.every=30", "checkpoint.every=30", "optimize.log_every=10")
    run = train(tiny_scene, tmp_path / "run", *short, pipeline="auto_opti3dgs_7k")
    assert run.numbers.keys() > NUMBERS
    assert run.numbers["haar/scale"] == pytest.approx(30 * 4.3e-4, rel=0.1)
    assert abs(run.numbers["haar/leak"]) < 30 * 4.3e-4
    plain = train(tiny_scene, tmp_path / "plain", *short, pipeline="splat_7k")
    psnr = [one.metrics["test"]["1"]["psnr"] for one in (run, plain)]
    assert psnr[0] == pytest.approx(psnr[1], abs=1.5)
