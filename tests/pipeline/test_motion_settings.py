"""Settings that conflict with moving Gaussians are refused with a remedy."""

import re
from collections.abc import Mapping
from typing import ClassVar, Literal

import pytest

from clsplat.core.errors import ConfigError
from clsplat.core.settings import rebuild_models
from clsplat.losses.base import Penalty
from clsplat.pipeline.loading import load

PIXELS = "optimize.losses=[l1, {type: covariance_trace, pixels: 2.0}]"


@pytest.mark.parametrize(
    ("override", "what"),
    [
        ("model.world_filter=smoothing", "model.world_filter: 'smoothing'"),
        ("densify.rules=[merge_neighbors]", "stages[1].optimize.during[1].densify.rules[0]: 'merge_neighbors'"),
        (PIXELS, "stages[1].optimize.losses[1]: 'covariance_trace'"),
    ],
)
def test_settings_with_static_positions_refuse_motion(override, what):
    with pytest.raises(ConfigError, match=f"{re.escape(what)} cannot be combined with .* \\(model.time\\): it uses"):
        load("dynamic_7k", [override])
    load("splat_7k", [override])


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
def test_extreme_motion_settings_are_refused(pipeline, override, bound):
    with pytest.raises(ConfigError, match=bound):
        load(pipeline, [override])


def test_filters_and_rules_that_read_no_positions_allow_motion():
    load("dynamic_7k", ["model.screen_filter=mip", "densify.rules=[clone, split_steepest, prune_unimportant]"])


def test_plugin_class_declares_a_conflict_in_its_stage(tmp_path, without_plugins):
    class Wave(Penalty):
        conflicts: ClassVar[Mapping[str, str]] = {"l2": "both are smooth", "sky": "it has no size; leave one out"}
        type: Literal["wave"] = "wave"

        def add(self, inputs): ...

    rebuild_models()
    losses = "optimize.losses=[l1, wave]"
    load("smoke", [losses])
    with pytest.raises(
        ConfigError, match=r"losses\[1\]: 'wave' .* with sky \(model.background\): it has .*; leave one"
    ):
        load("smoke", [losses, "model.background=envmap"])
    stage = "  - optimize: {steps: 1, losses: [%s]}\n"
    path = tmp_path / "x.yaml"
    path.write_text("name: x\nstages:\n  - init\n" + stage % "l1, wave" + stage % "l1, l2")
    load(str(path))
    path.write_text("name: x\nstages:\n  - init\n" + stage % "l2, wave")
    with pytest.raises(ConfigError, match=r"with l2 \(stages\[1\].*: both are smooth; leave one of them out"):
        load(str(path))
