"""Settings that do not go together with Gaussians that move are refused, with what to write instead."""

import re

import pytest

from clsplat.core.errors import ConfigError
from clsplat.pipeline.loading import load

PIXELS = "optimize.losses=[l1, {type: covariance_trace, pixels: 2.0}]"


@pytest.mark.parametrize(
    ("override", "what", "remedy"),
    [
        (
            "model.world_filter=smoothing",
            "model.world_filter.type 'smoothing'",
            "set `world_filter: {type: none}`",
        ),
        (
            "densify.rules=[merge_neighbours]",
            "stages[1] optimize: the rule 'merge_neighbours'",
            "give densify.rules without merge_neighbours",
        ),
        (PIXELS, "stages[1] optimize: the loss 'covariance_trace' with `pixels`", "remove the loss"),
    ],
)
def test_what_reads_places_at_rest_is_refused_beside_motion(override, what, remedy):
    with pytest.raises(ConfigError, match=f"{re.escape(what)} reads .* beside model.time: {re.escape(remedy)}, or"):
        load("dynamic_7k", [override])
    load("splat_7k", [override])


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        ("cleanup", r"the rule 'prune_far', which it has by default, reads .*: give cleanup.rules without prune_far"),
        ("cleanup: {rules: [prune_far]}", r"the rule 'prune_far' reads .*: give cleanup.rules without prune_far"),
        ("reinit_from_depth", "a depth is of one moment; expected Gaussians that stand still: remove the stage"),
    ],
)
def test_stages_that_need_rest_are_refused_on_reading(tmp_path, stage, words):
    path = tmp_path / "x.yaml"
    text = f"name: x\nmodel: {{time: {{}}}}\nstages:\n  - init\n  - {stage}\n  - export\n"
    path.write_text(text)
    with pytest.raises(ConfigError, match=rf"stages\[1\] {stage.partition(':')[0]}: {words}"):
        load(str(path))
    path.write_text(text.replace("model: {time: {}}\n", ""))
    load(str(path))
    path.write_text(text.replace(stage, "cleanup: {rules: [prune_faint]}"))
    load(str(path))


@pytest.mark.parametrize(
    ("pipeline", "override", "bound"),
    [
        ("dynamic_7k", "optimize.rates.motion.turn=1e300", "at most 100"),
        ("dynamic_7k", "optimize.rates.motion.velocity=-1", "at least 0"),
        ("mip_nerf", "train_field.rays=1000000000000", "at most 1048576"),
        ("mip_nerf", "train_field.field.far=1e300", "at most"),
        ("mip_nerf", "train_field.field.near=1e-300", "at least"),
    ],
)
def test_numbers_that_no_training_survives_are_refused(pipeline, override, bound):
    with pytest.raises(ConfigError, match=bound):
        load(pipeline, [override])


def test_filters_and_rules_that_read_no_positions_allow_motion():
    load("dynamic_7k", ["model.screen_filter=mip", "densify.rules=[clone, split_saddle, prune_unimportant]"])
