"""A box: containment, growth only inside it, and a model cropped to it."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from clsplat.density.control import Box
from clsplat.formats.table import read
from clsplat.scene.detect import read_scene
from tests.support.runs import digest, train

EASY = "densify.rules=[{type: clone, gradient_above: 1.0e-5, size_below: 10}]"


def test_box_includes_its_lower_faces_only():
    box = Box(low=[0, None, None], high=[1, None, 2])
    points = np.array([[0, 9, 0], [1, 0, 0], [-1e-9, 0, 0], [0.5, -9, 2], [0.5, np.nan, 0], [0.5, np.inf, -np.inf]])
    assert box.contains(points).tolist() == [True, False, False, False, False, True]
    assert Box().contains(points).tolist() == [True] * 4 + [False, True]


@pytest.mark.parametrize("high", [0.0, -1.0])
def test_empty_box_is_refused(high):
    with pytest.raises(ValidationError, match=r"expected 'low' below 'high' on each axis, got 0 and -?\d for y"):
        Box(low=[None, 0.0, None], high=[None, high, None])


def count_growth(out) -> int:
    return sum(
        json.loads(line)["grown"].get("clone", 0)
        for line in (out / "metrics.jsonl").read_text().splitlines()
        if json.loads(line)["kind"] == "densify"
    )


@pytest.mark.slow
def test_only_gaussians_inside_grow(tiny_scene, tmp_path):
    box = "densify.inside={low: [0, null, null]}"
    common = (
        EASY,
        "optimize.steps=14",
        "optimize.rates.means=0",
        "init.count=200",
        "densify.every=4",
        "densify.start=3",
    )  # so that they stay where they are
    train(tiny_scene, tmp_path / "whole", *common)
    train(tiny_scene, tmp_path / "half", *common, box)
    train(tiny_scene, tmp_path / "none", *common, "densify.inside={low: [1000, null, null]}")
    means = {name: read(tmp_path / name / "point_cloud.ply").parameters["means"][:, 0] for name in ("none", "half")}
    assert (means["half"] < 0).sum() == (means["none"] < 0).sum()
    assert (means["half"] >= 0).sum() > (means["none"] >= 0).sum()
    assert count_growth(tmp_path / "whole") > count_growth(tmp_path / "half") > 0 == count_growth(tmp_path / "none")


@pytest.mark.slow
def test_crop_leaves_gaussians_inside_unchanged(tiny_scene, tmp_path):
    run = train(tiny_scene, tmp_path / "whole", "optimize.steps=2")
    half = {"inside": {"low": [0.1, None, None]}}
    stages = [{"init": {"source": "model", "file": str(run.out)}}, {"crop": half}, {"export": {}}]
    (tmp_path / "crop.yaml").write_text(json.dumps({"name": "crop", "stages": stages}))
    cropped = train(tiny_scene, tmp_path / "part", pipeline=str(tmp_path / "crop.yaml")).out
    before, after = (read(out / "point_cloud.ply").parameters for out in (run.out, cropped))
    kept = before["means"][:, 0] >= 0.1
    assert 0 < kept.sum() < len(kept)
    for name in ("means", "quats", "sh_base", "logit_opacity"):
        np.testing.assert_array_equal(after[name], before[name][kept])


@pytest.mark.slow
def test_part_trains_with_the_extent_of_the_scene(tiny_scene, tmp_path):
    extent = read_scene(tiny_scene).extent
    plain = train(tiny_scene, tmp_path / "plain", "optimize.steps=3")
    given = train(tiny_scene, tmp_path / "given", "optimize.steps=3", f"scene.extent={extent!r}")
    other = train(tiny_scene, tmp_path / "other", "optimize.steps=3", f"scene.extent={2 * extent!r}")
    assert digest(plain.out) == digest(given.out) != digest(other.out)
